"""Sample measurements: the published coin from a server, its checksum, its licence; the built-in example."""

import functools
import http.server
import threading

import numpy as np
import pytest

import opfem as op
from opfem import datasets


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server on this machine in place of the real one; yields the folder that it serves."""
    folder = tmp_path / "served"
    folder.mkdir()

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder)) as answering:
        thread = threading.Thread(target=answering.serve_forever)
        thread.start()
        monkeypatch.setattr(datasets, "_URL", f"http://127.0.0.1:{answering.server_port}/{datasets._COIN}")
        yield folder
        answering.shutdown()
        thread.join()


def test_coin_is_downloaded_once_and_checked(shared, server, tmp_path, monkeypatch):
    monkeypatch.setenv("OPFEM_DATA", str(tmp_path / "cache"))
    served = server / datasets._COIN
    served.write_bytes((shared / "data" / datasets._COIN).read_bytes())
    coin = op.datasets.coin()
    assert coin.shape == (502, 502)
    np.testing.assert_allclose(coin.extent, 5.0)
    assert 0.31 < float(coin.values.min()) < float(coin.values.max()) <= op.datasets.COIN_LAYER
    served.unlink()
    np.testing.assert_array_equal(op.datasets.coin().values, coin.values)


def test_another_file_is_refused(server, tmp_path):
    (server / datasets._COIN).write_bytes(b"not the coin")
    with pytest.raises(OSError, match=r"(?s)coin_5c_1-thickness.mat.*GPL-3.*hash.*OPFEM_DATA"):
        datasets.coin_file(tmp_path / "cache")
    assert not (tmp_path / "cache" / datasets._COIN).exists()


def test_without_a_network_the_error_says_what_to_do(server, tmp_path):
    with pytest.raises(OSError, match=r"(?s)Could not get .*computational-optical-palpation.*by hand"):
        datasets.coin_file(tmp_path / "cache")


def test_example_is_the_built_in_map():
    example = op.datasets.example(seed=3)
    assert np.any(example.mask)
    assert not np.array_equal(example.values, op.datasets.example().values)
