# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP with its cache on a full disk and on a read-only one."""

import subprocess
import sys
from pathlib import Path

import pytest
from clip_reference import SMALL_CONFIG
from disks import small_disk

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
PRELUDE = f"""
import json, logging, pathlib, subprocess, sys
import numpy as np
import open_clip
from cliploc_ros.models.clip_encoder import load_encoder
from cliploc_ros.models.clip_weights import ClipOptions

folder = pathlib.Path(sys.argv[1])
logging.basicConfig(format='%(levelname)s %(message)s')
config = pathlib.Path(sys.argv[2]).with_suffix('.json')
config.write_text(json.dumps({SMALL_CONFIG!r}))
options = ClipOptions(model=str(config), pretrained=sys.argv[2], device='cpu',
                      cache_dir=str(folder / 'cache'), inference='pytorch')
labels = [f'thing number {{number}}' for number in range(100)]  # 26 kB

def load(labels=labels):
    return load_encoder(options, labels).label_embeddings.unique

def files():
    return sorted(file for file in (folder / 'cache' / 'labels').iterdir())

def say(text):
    print(text, file=sys.stderr)
"""


def run(folder, small_clip, script):
    """Run a script with a small disk; return the lines of its standard error."""
    disk = folder / 'disk'
    disk.mkdir()
    weights = folder / small_clip.file.name
    weights.symlink_to(small_clip.file)
    done = subprocess.run(
        [*small_disk(disk), sys.executable, '-c', PRELUDE + script, str(disk), str(weights)],
        cwd=PROJECT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr.splitlines()


def test_a_full_disk_costs_only_the_cache(tmp_path, small_clip):
    """A write fails halfway and leaves nothing; with room again the next one succeeds."""
    lines = run(tmp_path, small_clip, """
(folder / 'cache').mkdir()
(folder / 'filler').write_bytes(bytes(56 * 1024))
full = load()
assert full.shape == (100, 64) and files() == []
assert np.array_equal(load(), full) and files() == []
say('room')
(folder / 'filler').unlink()
assert np.array_equal(load(), full)
file, = files()
say('damage')
file.write_bytes(file.read_bytes()[:-100])
(folder / 'filler').write_bytes(bytes(12 * 1024))
with (folder / 'rest').open('wb', buffering=0) as rest:
    try:
        while rest.write(bytes(1024)):
            pass
    except OSError:
        pass
assert np.array_equal(load(), full)
say('room')
(folder / 'filler').unlink()
(folder / 'rest').unlink()
load()
assert np.array_equal(load(), full) and files() == [file]
""")
    before, after, damaged, mended = _parts(lines, 'room', 'damage', 'room')
    assert len(before) == 2 and after == []
    for line in (*before, damaged[-1]):
        assert 'cannot write' in line and '/disk/cache/labels/labels-' in line
        assert 'No space left on device' in line and 'make room' in line and 'cache_dir' in line
    assert len(damaged) == 2 and 'cannot be used' in damaged[0]
    assert len(mended) == 1 and 'cannot be used' in mended[0]


def test_a_read_only_cache_is_read(tmp_path, small_clip):
    lines = run(tmp_path, small_clip, """
written = load()
assert len(files()) == 1
subprocess.run(['mount', '-o', 'remount,ro', str(folder)], check=True)
assert np.array_equal(load(), written)
say('other labels')
assert load(['a mug']).shape == (1, 64)
assert len(files()) == 1
""")
    known, others = _parts(lines, 'other labels')
    assert known == []
    assert len(others) == 1 and 'Read-only file system' in others[0]
    assert 'cannot write' in others[0] and 'cache_dir' in others[0]


def _parts(lines, *words):
    """Return the warnings before, between and after some lines."""
    parts = [[]]
    for line in lines:
        if words and line == words[0]:
            words = words[1:]
            parts.append([])
        elif line.startswith('WARNING'):
            parts[-1].append(line)
    assert not words
    return parts
