"""Download of the detector's network file."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from stga_addon.cli.main import main
from stga_addon.tracking import detector_file

CONTENT = b"a network"


@pytest.fixture
def served(monkeypatch):
    """A server that answers every request with CONTENT, except /missing; returns its address and its requests."""
    requests = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append(self.path)
            self.send_response(404 if self.path == "/missing" else 200)
            self.end_headers()
            self.wfile.write(CONTENT)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(detector_file, "TASK_SHA256", hashlib.sha256(CONTENT).hexdigest())
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setattr(detector_file, "TASK_URL", f"{address}/face.task")
    yield address, requests
    server.shutdown()
    server.server_close()
    thread.join()


def test_the_file_is_downloaded_once(served, tmp_path):
    """Catches a file that is fetched with every run, or that the user's own is replaced by."""
    path = tmp_path / "models/face.task"
    detector_file.download_task(path)
    assert path.read_bytes() == CONTENT
    path.write_bytes(b"the user's own")
    detector_file.download_task(path)
    assert path.read_bytes() == b"the user's own"
    assert served[1] == ["/face.task"]


def test_other_content_is_refused(served, tmp_path, monkeypatch):
    """Catches a captive portal's page, or a replaced file, that is run as a network."""
    monkeypatch.setattr(detector_file, "TASK_SHA256", "0" * 64)
    with pytest.raises(detector_file.StgaError, match=r"face\.task: http://.* has SHA-256 \w{64}, expected 0{64}"):
        detector_file.download_task(tmp_path / "face.task")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_read_is_named(served, tmp_path, monkeypatch):
    """Catches a traceback, or an empty file, where the address is gone or the machine is offline."""
    for url, reason in ((f"{served[0]}/missing", "Not Found"), ("http://127.0.0.1:9/face.task", "refused")):
        monkeypatch.setattr(detector_file, "TASK_URL", url)
        with pytest.raises(detector_file.StgaError, match=rf"cannot be downloaded from {url} \(.*{reason}"):
            detector_file.download_task(tmp_path / "face.task")
    assert list(tmp_path.iterdir()) == []


def test_a_download_needs_a_file_to_write(tmp_path, capsys):
    """Catches a download into a folder that the user does not know of."""
    assert main(["track", str(tmp_path), "--model", "head.npz", "--out", "out", "--download-detector"]) == 2
    assert "--download-detector: give the file to write with --detector" in capsys.readouterr().err
