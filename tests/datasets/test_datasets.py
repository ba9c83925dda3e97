"""Published flights: found in a folder, downloaded with a checksum, or asked for."""

import functools as ft
import hashlib
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.io import savemat

import jaxquad as jq
from jaxquad.cli import main
from jaxquad.datasets import DataFile, FILES, locate
from jaxquad.records import ReadError


CONTENT = b"t,u,y\n" + b"".join(b"%.2f,%d,%d\n" % (k / 100, k % 7, k % 5) for k in range(100))


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and counts what it is asked for."""

    asked: list[str] = []

    def log_message(self, *_):
        self.asked.append(self.path)


@pytest.fixture
def server(tmp_path):
    (tmp_path / "public").mkdir()
    (tmp_path / "public" / "log.csv").write_bytes(CONTENT)
    Quiet.asked = []
    handler = ft.partial(Quiet, directory=str(tmp_path / "public"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


@pytest.fixture(autouse=True)
def nothing_here(tmp_path, monkeypatch):
    """A user without the data, with an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("JAXQUAD_DATA", raising=False)


def published(address, content=CONTENT):
    return DataFile("made", "log.csv", f"{address}/log.csv", hashlib.sha256(content).hexdigest())


pooch_only = pytest.mark.skipif(
    find_spec("pooch") is None,
    reason="pooch is not installed: pip install 'jaxquad[datasets]'",
)


@pooch_only
def test_a_file_is_downloaded_once_and_is_what_was_published(server, tmp_path):
    path = locate(published(server))
    assert path.read_bytes() == CONTENT and path.is_relative_to(tmp_path / "cache")
    assert locate(published(server)) == path and Quiet.asked == ["/log.csv"]
    path.write_bytes(CONTENT[:-1])  # a damaged copy is replaced
    assert locate(published(server)).read_bytes() == CONTENT
    assert jq.read(path, inputs="u", outputs="y").samples == 100


@pooch_only
def test_another_file_than_the_published_one_is_refused_and_not_kept(server, tmp_path):
    with pytest.raises(ReadError, match="SHA-256 differs"):
        locate(published(server, CONTENT + b"\n"))
    assert not list((tmp_path / "cache").rglob("log.csv"))


@pooch_only
def test_a_missing_file_and_a_missing_server_are_told_apart_from_a_wrong_file(server):
    gone = published(server)._replace(origin=f"{server}/gone.csv")
    for file in (gone, published("http://127.0.0.1:9")):
        with pytest.raises(ReadError, match=r"JAXQUAD_DATA is not set.*cannot be downloaded"):
            locate(file)


def test_the_folder_that_is_named_comes_first(server, tmp_path, monkeypatch):
    (tmp_path / "mine" / "made").mkdir(parents=True)
    mine = tmp_path / "mine" / "made" / "log.csv"
    mine.write_bytes(CONTENT)
    monkeypatch.setenv("JAXQUAD_DATA", str(tmp_path / "mine"))
    assert locate(published(server)) == mine and not Quiet.asked


def test_what_has_no_checksum_is_asked_for_by_its_origin(tmp_path, monkeypatch):
    with pytest.raises(ReadError, match=r"log_3.*no checksum.*https://github.com/MattiaDiMauro"):
        jq.datasets.antx_pitch()
    time = np.arange(40.0, 80.0, 0.004)
    values = {name: np.sin((k + 1) * time) for k, name in enumerate(("M", "q", "x0"))}
    (tmp_path / "antx_pitch").mkdir()
    file = tmp_path / "antx_pitch" / FILES["antx_pitch prbs"].name
    savemat(file, {name: {"timestamp": time, "value": x} for name, x in values.items()})
    monkeypatch.setenv("JAXQUAD_DATA", str(tmp_path))
    record = jq.datasets.antx_pitch()  # its publisher's layout: a struct per channel
    np.testing.assert_allclose(record.channel("q"), np.sin(2 * record.time), atol=2e-3)


def test_the_demo_says_where_to_get_its_flight_before_it_computes(capsys):
    assert main(["demo", "--flight"]) == 2
    assert "take it from https://github.com/" in capsys.readouterr().err


def test_every_file_that_can_be_downloaded_is_pinned():
    for file in FILES.values():
        assert file.origin.startswith("https://")
        assert not file.sha256 or file.origin.endswith(f"/{file.name}")
        assert len(file.sha256) in (0, 64)


@pytest.mark.parametrize("key", [key for key, file in FILES.items() if file.sha256])
def test_the_copies_of_the_tests_are_what_was_published(data, key):
    file = FILES[key]
    content = (data / file.folder / file.name).read_bytes()
    assert hashlib.sha256(content).hexdigest() == file.sha256


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rate", "duration", "names"),
    [
        ("antx_pitch", 250.0, 26.0, ("M", "q", "x0")),
        ("crazyflie_rollpitch", 1010.0, 35.0, ("torque", "p")),
        ("betaflight_ar8", 985.0, 17.0, ("pid_sum", "q", "setpoint")),
        ("crazypad_hover", 101.2, 25.8, ("command", "p")),
        ("cessna_xplane", 40.0, 290.0, ("elevator", "q")),
    ],
)
@pytest.mark.filterwarnings("ignore::jaxquad.records.RecordWarning")
def test_each_flight_is_the_record_that_it_is_said_to_be(
    data, monkeypatch, name, rate, duration, names
):
    monkeypatch.setenv("JAXQUAD_DATA", str(data))
    record = getattr(jq.datasets, name)()
    assert record.names == names
    assert record.sample_rate == pytest.approx(rate, rel=1e-3)
    assert record.duration == pytest.approx(duration, abs=0.05)
    assert record.unit(record.output_names[0]) == "rad/s"
