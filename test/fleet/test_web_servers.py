# SPDX-License-Identifier: Apache-2.0

"""Recordings of web servers that are slow, silent, or state no type of their content."""

from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
import time

from adxl_ros.fleet import inputs
from adxl_ros.fleet.inputs import find_sources, FoundRecording
from adxl_ros.fleet.task import stage, StagingError
import pytest

http = pytest.importorskip('fsspec.implementations.http', reason='fsspec is not installed')

_PART = b'0.0,2.5\n' * 1000


@contextmanager
def web_server(parts, wait_s=0.0, needs=''):
    """Serve pieces with a wait before each, at addresses with `needs`; yield address and reads."""
    reads = []

    class Handler(BaseHTTPRequestHandler):
        """Serves one file in pieces, and notes its reads."""

        def do_HEAD(self):
            self.send_response(200 if needs in self.path else 403)
            self.send_header('Content-Length', str(parts * len(_PART)))
            self.send_header('ETag', '"1"')
            self.end_headers()

        def do_GET(self):
            reads.append(self.path)
            self.do_HEAD()
            for _ in range(parts):
                time.sleep(wait_s)
                self.wfile.write(_PART)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(('127.0.0.1', 0), Handler) as server:
        server.block_on_close = False
        server.handle_error = lambda *_: None
        Thread(target=server.serve_forever, daemon=True).start()
        yield f'http://127.0.0.1:{server.server_address[1]}/run.csv', reads
        server.shutdown()


def test_a_recording_is_read_once(tmp_path):
    """The server states no type of the content, as for a suffix that it does not know."""
    with web_server(3) as (url, reads):
        staged = stage(FoundRecording(url), tmp_path)
    assert staged.path.read_bytes() == 3 * _PART
    assert reads == ['/run.csv']


def test_a_silent_server_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(inputs, '_SILENCE_S', 0.2)
    with web_server(2, 2.0) as (url, _), pytest.raises(StagingError, match='cannot be read'):
        stage(FoundRecording(url), tmp_path)


def test_a_token_opens_a_recording_and_stays_out_of_its_row(tmp_path):
    """The server refuses a token that is no longer valid; another parameter is another file."""
    with web_server(1, needs='token=SECRET2') as (url, _):
        first, second = (find_sources([f'{url}?x={x}&token=SECRET2'])[0] for x in (1, 2))
        (old,) = find_sources([f'{url}?token=SECRET1&x=1'])
        assert stage(first, tmp_path).path.read_bytes() == _PART
        with pytest.raises(StagingError, match='Forbidden') as error:
            stage(replace(first, address=f'{url}?token=SECRET1&x=1'), tmp_path)
    assert (first.url, second.url, old.url) == (f'{url}?x=1', f'{url}?x=2', f'{url}?x=1')
    assert 'SECRET' not in f'{first} {old} {error.value}'
