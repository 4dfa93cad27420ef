# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure time and memory of a start of CLIP: open_clip's own, a first one, one with a warm cache.

    python -m studies.speed startup --model ViT-L-14

Each start is a process of its own. Without ``--checkpoint`` the weights are random.
"""

import argparse
import gc
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cliploc_ros.models.clip_encoder import load_encoder
from cliploc_ros.models.clip_weights import ClipOptions

KINDS = ('open_clip', 'first start', 'warm cache')
_LABELS = tuple(f'a label of a map, number {number}' for number in range(40))


@dataclass(frozen=True)
class StartupResult:
    """Time and memory of one start."""

    kind: str  #: One of KINDS
    seconds: float  #: From the imports done to labels embedded and crops ready to encode [s]
    #: Greatest resident memory of the process [MiB]. It includes the pages of mapped files, which
    #: the system can reclaim.
    peak_mib: float
    imports_mib: float  #: The same after the imports alone [MiB]
    weights_mib: float  #: Parameters in memory at the end [MiB]
    holds_text_tower: bool  #: Whether the table of token embeddings is among them


def measure_startup(kind: str, options: ClipOptions) -> StartupResult:
    """Start CLIP in a new process; return its time and memory."""
    command = [sys.executable, '-m', 'studies.speed', 'startup', '--child', kind,
               '--options', json.dumps(asdict(options))]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return StartupResult(**json.loads(done.stdout))


def write_random_checkpoint(model: str, file: Path) -> None:
    """Write random weights of a model, the same each time."""
    code = ('import sys, open_clip, torch; torch.manual_seed(0); '
            'torch.save(open_clip.create_model(sys.argv[1]).state_dict(), sys.argv[2])')
    subprocess.run([sys.executable, '-c', code, model, str(file)], check=True,
                   stderr=subprocess.DEVNULL)


def format_results(results: list[StartupResult]) -> str:
    """Return a table, with ratios to the first row."""
    lines = [f'{"start":<12} {"time s":>8} {"ratio":>6} {"peak MiB":>9} {"above imports":>14} '
             f'{"ratio":>6} {"weights MiB":>12}']
    for result in results:
        above = result.peak_mib - result.imports_mib
        lines.append(
            f'{result.kind:<12} {result.seconds:8.2f} {result.seconds / results[0].seconds:6.2f} '
            f'{result.peak_mib:9.0f} {above:14.0f} '
            f'{above / (results[0].peak_mib - results[0].imports_mib):6.2f} '
            f'{result.weights_mib:12.0f}')
    return '\n'.join(lines)


def _start_and_report(kind: str, options: ClipOptions) -> StartupResult:
    import open_clip  # noqa: F401  (before the measurement)
    import torch

    imports_mib = _peak_mib()
    started = time.perf_counter()
    kept = _start_open_clip(options) if kind == KINDS[0] else load_encoder(options, _LABELS)
    seconds = time.perf_counter() - started
    gc.collect()
    parameters = [thing for thing in gc.get_objects()
                  if issubclass(type(thing), torch.nn.Parameter) and not thing.is_meta]
    del kept
    return StartupResult(
        kind=kind, seconds=seconds, peak_mib=_peak_mib(), imports_mib=imports_mib,
        weights_mib=sum(each.numel() * each.element_size() for each in parameters) / 2**20,
        holds_text_tower=any(each.ndim == 2 and each.shape[0] > 40000 for each in parameters))


def _start_open_clip(options: ClipOptions) -> Any:
    import open_clip
    import torch

    model, _, preprocess = open_clip.create_model_and_transforms(
        options.model, pretrained=options.pretrained)
    with torch.inference_mode():
        labels = model.encode_text(open_clip.get_tokenizer(options.model)(list(_LABELS)))
        model.encode_image(torch.zeros(1, 3, *_as_pair(model.visual.image_size)))
    return model, preprocess, labels


def _as_pair(size: int | tuple[int, int]) -> tuple[int, int]:
    return (size, size) if isinstance(size, int) else size


def _peak_mib() -> float:
    # Not ru_maxrss, which includes the peak of the parent process before exec.
    match = re.search(r'VmHWM:\s+(\d+) kB', Path('/proc/self/status').read_text())
    assert match
    return int(match[1]) / 1024


def run(arguments: Sequence[str]) -> int:
    """Print the table for a model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--model', default='ViT-B-32', help='a name of open_clip.list_models()')
    parser.add_argument('--checkpoint', help='its weights as a file; random ones if not given')
    parser.add_argument('--child', choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument('--options', help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child:
        options = ClipOptions(**json.loads(given.options))
        print(json.dumps(asdict(_start_and_report(given.child, options))))
        return 0
    with tempfile.TemporaryDirectory(prefix='cliploc_ros_startup_') as folder:
        checkpoint = given.checkpoint
        if not checkpoint:
            checkpoint = str(Path(folder) / 'random.pt')
            write_random_checkpoint(given.model, Path(checkpoint))
        options = ClipOptions(given.model, checkpoint, device='cpu', cache_dir=folder)
        results = [measure_startup(kind, options) for kind in KINDS]
    print(f'CLIP {given.model} on the CPU, {len(_LABELS)} labels')
    print(format_results(results))
    return 0
