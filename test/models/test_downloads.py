# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Downloads from a local model hub, without a network, and to a full disk.

They run in separate processes: the libraries read addresses and proxies once, on import.
"""

import http.server
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from disks import small_disk
from safetensors.torch import save

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
RESOLVE = """
import json, sys
from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
try:
    weights = resolve_clip_weights(ClipOptions('ViT-B-32', 'openai', cache_dir=sys.argv[1]))
except ModelError as error:
    print(json.dumps({'error': str(error)}))
else:
    print(json.dumps({'file': str(weights.file), 'key': weights.key, 'gelu': weights.quick_gelu}))
"""
LOAD_YOLO = """
import json, sys
from cliploc_ros.errors import ModelError
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions
try:
    load_detector(DetectorOptions('yolov8n', device='cpu', cache_dir=sys.argv[1]))
except ModelError as error:
    print(json.dumps({'error': str(error)}))
"""


def run(script: str, cache: Path, *within: str, **environment: str) -> dict[str, str]:
    """Run a script with a cache folder; return what it printed."""
    done = subprocess.run(
        [*within, sys.executable, '-c', script, str(cache)], cwd=PROJECT, text=True,
        env={**os.environ, 'NO_PROXY': '127.0.0.1', **environment}, capture_output=True,
        timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_no_network_for_yolo(tmp_path):
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        port = free.getsockname()[1]
    # A port without a listener refuses connections at once.
    text = run(LOAD_YOLO, tmp_path, HTTPS_PROXY=f'http://127.0.0.1:{port}')['error']
    assert 'yolov8n.pt' in text and 'on another machine' in text
    assert list((tmp_path / 'weights').iterdir()) == []


class Hub(http.server.BaseHTTPRequestHandler):
    """The parts of a model hub that a download needs."""

    weights = b''
    name = 'open_clip_model.safetensors'
    requests: list[str]

    def do_HEAD(self):
        self.requests.append(self.path)
        if not self.path.endswith(self.name):
            self.send_response(404)
            self.send_header('X-Error-Code', 'EntryNotFound')
            self.end_headers()
            return
        self.send_response(200)
        self.send_header('ETag', '"0123456789abcdef"')
        self.send_header('X-Repo-Commit', '0' * 40)
        self.send_header('Content-Length', str(len(self.weights)))
        self.end_headers()

    def do_GET(self):
        self.do_HEAD()
        self.wfile.write(self.weights)

    def log_message(self, *arguments):
        pass


@pytest.fixture
def hub(monkeypatch, tmp_path):
    monkeypatch.setattr(Hub, 'weights', save({'visual.proj': torch.zeros(64, 64)}))
    Hub.requests = []
    monkeypatch.setenv('HF_HOME', str(tmp_path / 'hub'))
    with http.server.ThreadingHTTPServer(('127.0.0.1', 0), Hub) as server:
        monkeypatch.setenv('HF_ENDPOINT', f'http://127.0.0.1:{server.server_port}')
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield Hub
        server.shutdown()


def test_a_download_is_made_once(hub, tmp_path):
    first = run(RESOLVE, tmp_path / 'cache')
    assert Path(first['file']).read_bytes() == hub.weights
    assert (tmp_path / 'cache/weights') in Path(first['file']).parents
    hub.requests.clear()
    again = run(RESOLVE, tmp_path / 'cache')
    assert again == first and again['gelu']
    # A robot without a network does not wait for it.
    assert hub.requests == []


def test_weights_that_do_not_fit_on_the_disk(hub, tmp_path):
    hub.weights = save({'visual.proj': torch.zeros(256, 256)})
    disk = tmp_path / 'disk'
    disk.mkdir()
    text = run(RESOLVE, disk, *small_disk(disk))['error']
    assert f'{disk}/weights is full' in text
    assert 'on another machine' in text
