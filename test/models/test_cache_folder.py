# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Only the user can write to the default cache."""

import os
import stat
import subprocess
import sys
from pathlib import Path

from cliploc_ros.files.storage import resolve_cache_dir

PROJECT = Path(__file__).resolve().parents[2]
RESOLVE = """
import logging, os, stat, sys
from cliploc_ros.files.storage import resolve_cache_dir
logging.basicConfig(format='%(levelname)s %(message)s')
folder = resolve_cache_dir('')
assert resolve_cache_dir('') == folder
print(folder, oct(stat.S_IMODE(folder.stat().st_mode)), folder.stat().st_uid == os.getuid())
"""


def resolve(*within: str, **environment: str) -> tuple[list[str], str]:
    """Resolve the default cache in a process; return folder, mode and owner, and the log."""
    variables = {name: value for name, value in os.environ.items() if name != 'XDG_CACHE_HOME'}
    done = subprocess.run([*within, sys.executable, '-c', RESOLVE], cwd=PROJECT, text=True,
                          env=variables | environment, capture_output=True, timeout=300,
                          check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split(), done.stderr


def test_the_default_is_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.delenv('XDG_CACHE_HOME', raising=False)
    assert resolve_cache_dir('') == tmp_path / '.cache/cliploc_ros'
    monkeypatch.setenv('XDG_CACHE_HOME', 'relative is to be ignored')
    assert resolve_cache_dir('') == tmp_path / '.cache/cliploc_ros'
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'xdg'))
    assert resolve_cache_dir('') == tmp_path / 'xdg/cliploc_ros'
    assert resolve_cache_dir('~/mine') == tmp_path / 'mine'
    assert stat.S_IMODE((tmp_path / 'xdg/cliploc_ros').stat().st_mode) == 0o700


def test_a_cache_that_others_can_write_to_is_not_used(tmp_path):
    shared = tmp_path / '.cache/cliploc_ros'
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    (folder, mode, _), log = resolve(HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert Path(folder).name.startswith('cliploc_ros_cache_') and mode == '0o700'
    assert f'other users own {shared} or can write to it' in log and 'set cache_dir' in log
