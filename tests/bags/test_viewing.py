"""What a person is shown: fresh words only, the worst samples, names as text, this machine only."""

import http.client
import json
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit
from xml.etree import ElementTree

import pytest

from bags.chain.faults import FAULTS, write_faulty_copy
from bags.chain.shipped import config_file
from bags.designs import documents
from bags.designs.wiring import read_at
from bags.monitoring.replay import replay_messages
from bags.viewing import scene
from bags.viewing.drawn import HalfWidths
from bags.viewing.page import MOST_READERS, PAGE, serve_page
from bags.viewing.replay import Recording
from bags.viewing.scene import ERROR, OK, STALE, WARN, Scene
from nlsid import Status, f1tenth
from nlsid_core.errors import DataError
from nlsid_core.running.comparison import Centre
from tests.browser import CHROMIUM, MISSING, Page, browser

LOCAL = "127.0.0.1"
GOOD = {"margin": 0.5, "assumption": 0.1, "nominal": 1.0, "measured": 1.1, "half_width": 0.4}
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)


@pytest.fixture
def watched() -> Scene:
    """A monitor that says inside, and a good sample."""
    shown = Scene("a robot", "monitor")
    shown.sample(10**9, GOOD)
    shown.say(10**9, "monitor", OK, "inside", names=["speed [m/s]"])
    return shown


class Clock:
    """`time.monotonic` of the scene, which a test may move on."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.ahead, self._real = 0.0, time.monotonic
        patch.setattr("bags.viewing.scene.time.monotonic", lambda: self._real() + self.ahead)


def test_inside_is_said_while_word_and_samples_are_fresh(watched: Scene) -> None:
    assert watched.verdict() == scene.Verdict("inside", OK, "")


def test_inside_ends_when_no_sample_comes_though_the_monitor_goes_on(
    watched: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    Clock(monkeypatch).ahead = scene.LATE + 0.1
    watched.say(2 * 10**9, "monitor", OK, "inside")
    said = watched.verdict()
    assert (said.word, said.level) == ("late", STALE)
    assert "no sample has come for 1.1 s" in said.text


def test_inside_ends_when_the_monitor_is_silent_though_samples_come(
    watched: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    Clock(monkeypatch).ahead = scene.SILENT + 0.6
    watched.sample(2 * 10**9, GOOD)
    said = watched.verdict()
    assert (said.word, said.level) == ("stale", STALE)
    assert "has said nothing for 3 s" in said.text


@pytest.mark.parametrize(
    ("level", "text", "word", "shown"),
    [
        (WARN, "warning", "warning", WARN),
        (ERROR, "outside: outside the tube", "outside", ERROR),
        (ERROR, "assumption violated: energy", "assumption violated", ERROR),
        (STALE, "unknown: no speed for 0.1 s", "unknown", STALE),
        (STALE, "inside", "unknown", STALE),
        (ERROR, "inside; design refused: forged", "error", ERROR),
        (OK, "whatever", "unknown", STALE),
    ],
)
def test_only_the_monitors_own_word_at_its_own_level_counts(
    watched: Scene, level: int, text: str, word: str, shown: int
) -> None:
    watched.say(2 * 10**9, "monitor", level, text)
    said = watched.verdict()
    assert (said.word, said.level) == (word, shown)


@pytest.mark.parametrize("margin", [math.nan, -0.1, -math.inf])
def test_inside_is_not_said_over_a_sample_that_is_not(watched: Scene, margin: float) -> None:
    watched.sample(2 * 10**9, GOOD | {"margin": margin})
    assert watched.verdict().word == "unknown"


def test_another_node_cannot_speak_for_the_monitor() -> None:
    shown = Scene("a robot", "monitor")
    shown.sample(1, GOOD)
    for name in ("other/monitor", "monitor2", *(f"node {i}" for i in range(100))):
        shown.say(1, name, OK, "inside")
    assert shown.verdict().word == "waiting"
    assert len(shown.nodes()) <= scene.MOST_NODES
    shown.say(1, "monitor", OK, "inside")
    assert shown.verdict().word == "inside", "a crowd does not keep the monitor out"


def test_a_cause_that_lasts_is_one_event_whatever_time_it_names(watched: Scene) -> None:
    told, _ = watched.events_after(0)
    for t in ("0.3", "1.3", "1e-05", "-2.5"):
        watched.say(2 * 10**9, "monitor", STALE, f"unknown: speed is nan at t = {t} s")
    assert watched.events_after(told)[0] == told + 1
    assert watched.nodes()["monitor"].text.endswith("-2.5 s"), "the newest is what is said"
    watched.say(3 * 10**9, "monitor", STALE, "unknown: no speed for 0.1 s")
    assert watched.events_after(told)[0] == told + 2


def test_of_too_many_samples_the_worst_are_kept() -> None:
    shown = Scene("a robot", "monitor")
    margins = [0.5] * 1000
    margins[123], margins[456] = -0.2, math.nan
    for k, margin in enumerate(margins):
        shown.sample(k, {"margin": margin})
    seen, kept = shown.samples_after(0, 10)
    assert (seen, len(kept)) == (1000, 10)
    assert (kept[1].stamp_ns, kept[4].stamp_ns) == (123, 456)
    assert shown.samples_after(seen, 10) == (1000, [])


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("speed\u202eknis\x00\x1b[31m", "speed knis [31m"),
        ("a\n\tb", "a b"),
        ("x" * 10_000, "x" * 299 + "…"),
        ("<b>ü</b>", "<b>ü</b>"),
    ],
)
def test_text_from_outside_is_printable_and_short(given: str, shown: str) -> None:
    assert scene.clean(given) == shown


def news(address: str) -> Iterator[dict[str, object]]:
    """What the page's stream sends."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30)
    connection.request("GET", "/stream")
    answer = connection.getresponse()
    try:
        while line := answer.readline():
            if line.startswith(b"data: "):
                yield json.loads(line[6:], parse_constant=lambda name: pytest.fail(name))
    finally:
        connection.close()


def test_the_stream_begins_with_the_past_and_goes_on_with_what_is_new(watched: Scene) -> None:
    watched.sample(2 * 10**9, GOOD | {"margin": math.nan, "time_to_exit": math.inf})
    with serve_page(watched, host=LOCAL, port=0) as address:
        stream = news(address)
        first = next(stream)
        watched.sample(3 * 10**9, GOOD)
        later = next(part for part in stream if part["samples"])
        stream.close()  # type: ignore[attr-defined]
    assert first["first"]
    assert first["verdict"] == ["unknown", STALE, "the newest sample is not judged inside"]
    samples = first["samples"]
    assert isinstance(samples, list)
    assert samples[0][2:] == [0.5, 0.1, None, None, [[1.0, 0.4, 1.1]]]
    assert samples[1][2:5] == [None, 0.1, "inf"]
    assert not later["first"]
    assert [sample[0] for sample in later["samples"]] == [3.0]  # type: ignore[attr-defined]
    assert later["verdict"] == ["inside", OK, ""]


def test_a_forecast_is_sent_once_at_the_stamp_it_is_about(watched: Scene) -> None:
    watched.forecast(15 * 10**8, {"low": 0.9, "high": 1.3, "ahead": 0.5})
    with serve_page(watched, host=LOCAL, port=0) as address:
        stream = news(address)
        first = next(stream)
        watched.forecast(16 * 10**8, {"low": math.nan, "high": 1.2, "ahead": 0.5})
        later = next(part for part in stream if part["forecasts"])
        stream.close()  # type: ignore[attr-defined]
    assert first["forecasts"] == [[1.5, [[0.9, 1.3]]]]
    assert later["forecasts"] == [[1.6, [[None, 1.2]]]]


@pytest.mark.parametrize(
    ("path", "host", "status"),
    [
        ("/", "localhost:80", 200),
        ("/", "127.0.0.1", 200),
        ("/", "evil.example", 403),
        ("/stream", "evil.example:8080", 403),
        ("/page.html", "localhost", 404),
        ("/../scene.py", "localhost", 404),
        ("//etc/passwd", "localhost", 404),
    ],
)
def test_the_page_serves_two_paths_to_its_own_name(
    watched: Scene, path: str, host: str, status: int
) -> None:
    with serve_page(watched, host=LOCAL, port=0) as address:
        connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30)
        connection.request("GET", path, headers={"Host": host})
        answer = connection.getresponse()
        assert answer.status == status
        assert answer.getheader("Access-Control-Allow-Origin") is None
        if status == 200:
            assert answer.read() == PAGE.read_bytes()
            assert "default-src 'none'" in str(answer.getheader("Content-Security-Policy"))
        connection.close()


def test_readers_are_limited_and_one_that_leaves_makes_room(watched: Scene) -> None:
    with serve_page(watched, host=LOCAL, port=0) as address:
        readers = [news(address) for _ in range(MOST_READERS)]
        for reader in readers:
            next(reader)
        assert list(news(address)) == []
        readers[0].close()  # type: ignore[attr-defined]
        deadline = time.monotonic() + 30
        while not list(zip(range(1), news(address), strict=False)):
            assert time.monotonic() < deadline


def test_a_port_that_is_taken_is_said(watched: Scene) -> None:
    with serve_page(watched, host=LOCAL, port=0) as address:
        port = urlsplit(address).port
        assert port is not None
        said = f"cannot serve on {LOCAL}, port {port}"
        with pytest.raises(DataError, match=said), serve_page(watched, host=LOCAL, port=port):
            pass


def test_the_page_loads_nothing_from_elsewhere() -> None:
    text = PAGE.read_text()
    for unwanted in ("http://", "https://", "innerHTML", " src=", "href="):
        assert unwanted not in text


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with browser(tmp_path / "profile") as opened:
        yield opened
    shutil.rmtree(tmp_path / "profile", ignore_errors=True)


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_the_words_and_takes_inside_back(page: Page, watched: Scene) -> None:
    going = threading.Event()

    def feed() -> None:
        k = 1
        while not going.wait(0.05):
            k += 1
            watched.sample(k * 50_000_000 + 10**9, GOOD)
            watched.say(10**9, "monitor", OK, "inside")

    feeder = threading.Thread(target=feed)
    feeder.start()
    word: Callable[[], str] = lambda: page.text("#word").lower()  # noqa: E731
    with serve_page(watched, host=LOCAL, port=0) as address:
        page.open(address, width=1280, height=900)
        page.wait(lambda: word() == "inside")
        assert page.text("#signals h2").startswith("speed [m/s]")
        assert page.text("#n-spent") == "10 %"
        foot = "document.querySelector('#replay').getBoundingClientRect().bottom"
        assert page.value("innerHeight") - page.value(foot) == pytest.approx(16, abs=4), "filled"
        going.set()
        feeder.join()
        page.wait(lambda: word() == "late")
        page.wait(lambda: word() == "stale")
        assert page.text("#n-margin") == "unknown"
    page.wait(lambda: word() == "no connection")
    page.wait(lambda: "what is shown is old. Nothing answers at" in page.text("#why"))


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_a_recording_that_is_over_as_it_ended(page: Page, watched: Scene) -> None:
    watched.sample(3 * 10**9, GOOD)
    watched.end("verdict: inside. 2.9 of 2.9 s judged")
    with serve_page(watched, host=LOCAL, port=0) as address:
        page.open(address)
        page.wait(lambda: page.text("#word").lower() == "recording over")
        assert page.text("#why").startswith("verdict: inside")
        assert (page.text("#n-age"), page.text("#n-margin")) == ("the last", "0.500")
        assert page.value("document.body.className") == ""
        page.value("document.querySelector('#play').click()")
        page.wait(lambda: page.text("#shown").endswith("before the newest"))


@pytest.mark.slow
@needs_browser
def test_a_browser_says_no_connection_when_the_stream_stands_still(
    page: Page, watched: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server is there and the connection open; only nothing comes."""
    monkeypatch.setattr(scene, "SILENT", 1e9)
    monkeypatch.setattr(scene, "LATE", 1e9)
    with serve_page(watched, host=LOCAL, port=0) as address:
        page.open(address)
        page.wait(lambda: page.text("#word").lower() == "inside")
        with watched._lock:  # whoever asks the scene waits
            page.wait(lambda: page.text("#word").lower() == "no connection")
        page.wait(lambda: page.text("#word").lower() == "inside")


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_hostile_names_as_text(page: Page) -> None:
    hostile = "<img src=x onerror=\"document.title='run'\"><script>document.title='run'</script>"
    shown = Scene(hostile, hostile)
    shown.sample(1, GOOD)
    shown.say(1, hostile, OK, "inside: " + hostile, names=[hostile])
    with serve_page(shown, host=LOCAL, port=0) as address:
        page.open(address)
        page.wait(lambda: hostile in page.text("#nodes"))
        for where in ("#source", "#events", "#signals h2"):
            assert hostile in page.text(where)
        assert page.value("document.querySelectorAll('img, main script').length") == 0
        assert page.value("document.title") != "run"


def test_a_recording_is_shown_with_the_readings_of_the_replay(funnel: Path, tmp_path: Path) -> None:
    proved = documents.load(funnel)
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    bad = tmp_path / "bad"
    write_faulty_copy(trial, bad, str(read_at(proved)), FAULTS["scaled by 0.6"])
    readings = replay_messages(proved, bad, centre=Centre.COMMAND)
    shown = Scene("a recording", "replay")
    Recording(proved, bad, centre=Centre.COMMAND).play(shown, 1e6, threading.Event())
    _, samples = shown.samples_after(0, 10**9)
    assert [s.stamp_ns for s in samples] == [entry.stamp_ns for entry in readings]
    margins = [s.numbers["margin"] for s in samples]
    assert margins == pytest.approx([e.reading.margin for e in readings], nan_ok=True, abs=0.0)
    width = proved.funnel.half_widths[0]
    assert {s.signal("half_width", 0) for s in samples} == {width}
    said = shown.verdict()
    assert (said.word, said.level) == ("recording over", STALE)
    first = next(
        e.reading
        for e in readings
        if e.reading.status is Status.OUTSIDE or e.reading.status is Status.ASSUMPTION_VIOLATED
    )
    assert said.text.startswith(f"verdict: {first.status.value}.")
    assert shown.names == ("speed [m/s]",)


def test_a_replay_keeps_the_pace_of_the_stamps_and_stops_when_asked(funnel: Path) -> None:
    proved = documents.load(funnel)
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    recording = Recording(proved, trial, centre=Centre.COMMAND)
    stamps = [e.stamp_ns for e in replay_messages(proved, trial, centre=Centre.COMMAND)]
    span = (max(stamps) - stamps[0]) / 1e9
    shown, closing = Scene("a recording", "replay"), threading.Event()
    began = time.monotonic()
    recording.play(shown, span / 0.3, closing)
    assert time.monotonic() - began >= 0.3
    closing.set()
    again = Scene("a recording", "replay")
    recording.play(again, 1.0, closing)
    assert again.samples_after(0, 10**9)[0] < len(stamps)
    assert again.verdict().word != "recording over"


def test_the_plotjuggler_layout_asks_for_what_is_published(funnel: Path) -> None:
    root = ElementTree.parse(config_file("plotjuggler_layout.xml")).getroot()
    asked = {curve.attrib["name"].split("/")[3] for curve in root.iter("curve")}
    proved = documents.load(funnel)
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    reading = replay_messages(proved, trial, centre=Centre.COMMAND)[-1].reading
    assert asked <= set(reading.numbers | HalfWidths(proved).of(reading))
