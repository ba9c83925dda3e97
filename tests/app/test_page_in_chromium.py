"""The page in Chromium, from a log that is dropped to files that are read back."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
from page_runs import chromium, served

from jaxquad.workflows import recipe, write_demo_log


pytest.importorskip("nicegui", reason="the extra app is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
# What Plotly answers where a figure is taken away while NiceGUI adapts its size.
GONE = "Resize must be passed a displayed plot div element"
LATE = 120_000  # ms: other tests run beside this one


@pytest.fixture(scope="module")
def browser():
    with chromium() as driver:
        yield driver


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with served(tmp_path_factory.mktemp("app")) as (address, _):
        yield address


@pytest.fixture
def page(browser, address):
    """A new tab, which has seen no message of an error and no request to elsewhere."""
    context = browser.new_context(
        viewport={"width": 1280, "height": 900}, accept_downloads=True,
        permissions=["clipboard-read", "clipboard-write"],
    )  # fmt: skip
    tab, wrong = context.new_page(), []
    tab.on("console", lambda x: wrong.append(x.text) if x.type == "error" else None)
    tab.on("pageerror", lambda error: None if GONE in str(error) else wrong.append(str(error)))
    tab.on("request", lambda x: None if _is_local(x.url) else wrong.append(x.url))
    tab.goto(address)
    tab.wait_for_selector("h1")
    yield tab
    context.close()
    assert wrong == []


def _is_local(url: str) -> bool:
    return url.startswith(("http://127.0.0.1:", "data:", "blob:"))


def drop(tab, path: Path) -> None:
    tab.set_input_files("input[type=file] >> nth=0", str(path))


def light(tab, axis: str) -> tuple[str, str]:
    """The class of an axis' light, once it is there, and its text."""
    lights = tab.locator("article.good, article.warn, article.bad")
    one = lights.filter(has=tab.locator("h3", has_text=axis))
    one.wait_for(timeout=LATE)
    return one.get_attribute("class").split()[-1], one.inner_text()


def files_are_there(tab) -> None:
    tab.get_by_role("link", name="Back to what flew").wait_for(timeout=LATE)


def changes(tab, *heads: str) -> dict[str, tuple[str, ...]]:
    """Old and new, or other columns, by the parameter."""
    rows = {}
    for table in tab.locator(".changes").all():
        names = table.locator("th").all_inner_texts()
        for row in table.locator("tbody tr").all():
            cells = dict(zip(names, row.locator("td").all_inner_texts(), strict=True))
            rows[cells["parameter"]] = tuple(cells[x] for x in heads or ("old", "new"))
    return rows


def is_at(tab, name: str) -> None:
    """The page has gone to a heading, which has the focus, below what stays at the top."""
    tab.wait_for_function(
        """name => { const x = document.activeElement, y = x.getBoundingClientRect().top
        return x.id == name && (y >= 0 && y < 120 || scrollY + innerHeight + 2 >
        document.documentElement.scrollHeight && y > 0 && y < innerHeight) }""",
        arg=name, timeout=LATE,
    )  # fmt: skip


def saved(tab, link: str) -> str:
    with tab.expect_download() as download:
        tab.get_by_role("link", name=link).first.click()
    return Path(download.value.path()).read_text()


def assigned(text: str) -> dict[str, str]:
    """What the lines of a Betaflight or ArduPilot file set."""
    return dict(re.findall(r"^(?:set )?(\w+)(?: = |,)(\S+)$", text, re.M))


def test_a_betaflight_log_becomes_files_that_are_those_of_the_table(page, data):
    drop(page, data / "betaflight_firmware" / "A_chirp_roll.BFL")
    page.locator(".js-plotly-plot .main-svg").first.wait_for(timeout=LATE)
    assert "chirp on roll" in page.inner_text("main")
    is_at(page, "log")
    assert light(page, "roll")[0] == "good"
    kind, sentence = light(page, "pitch")
    assert kind == "warn" and "cannot tell" in sentence and "jaxquad recipe" in sentence
    assert "You did not move pitch" in sentence
    is_at(page, "lights")
    files_are_there(page)
    rows = changes(page)
    assert {"p_roll", "i_roll", "d_roll"} <= set(rows)
    new, old = assigned(saved(page, "All of it")), assigned(saved(page, "Back to what flew"))
    for name, (before, after) in rows.items():
        assert new[name] == after and old[name] == before != after
    third = assigned(saved(page, "A third of the way"))
    before, after = map(float, rows["p_roll"])
    assert float(third["p_roll"]) == pytest.approx(before + (after - before) / 3, abs=4)

    page.get_by_role("button", name="copy proposal_100.txt").click()
    page.get_by_text("Copied").wait_for()
    page.wait_for_function("navigator.clipboard.readText().then(text => text.length > 20)")
    assert assigned(page.evaluate("navigator.clipboard.readText()")) == new
    inside = page.frame_locator("iframe[title='autopilot.html']")
    assert "What changes" in inside.locator("body").inner_text(timeout=LATE)

    page.get_by_role("button", name="Response and model, roll").click()
    page.locator("h3", has_text="roll: response and model").wait_for(timeout=LATE)
    is_at(page, "model")
    report = page.frame_locator("iframe[title='report.html']").locator("body")
    assert "gain" in report.inner_text(timeout=LATE)

    # A reload finds all of it again; calmer gains come without another identification.
    page.reload()
    files_are_there(page)
    assert changes(page) == rows
    assert page.get_by_role("slider", name="cool motors to warm motors").count() > 0
    page.get_by_role("slider", name="calm to sharp").focus()
    for limit in ("1.68", "1.56"):  # two moves, each until its gains are there
        shown = page.locator(".changes tbody").first.inner_text()
        while page.get_by_text(f"Worst Ms at most {limit}").count() == 0:
            page.keyboard.press("ArrowLeft")
            page.wait_for_timeout(50)
        page.wait_for_function(
            "old => document.querySelector('.changes tbody').innerText != old",
            arg=shown, timeout=LATE,
        )  # fmt: skip
        files_are_there(page)
    assert float(changes(page)["p_roll"][1]) < after
    # What the slider changed stands in the table, which a phone shows whole.
    assert changes(page, "old", "before the slider") == rows
    assert "Before the slider: A gust turns it" in page.inner_text("article.good")
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for table in page.locator(".changes .q-table__middle").all():
        assert table.evaluate("x => x.scrollWidth - x.clientWidth") <= 1
    assert page.evaluate("document.activeElement.getAttribute('role')") == "slider"
    files_are_there(page)
    assert assigned(saved(page, "All of it"))["p_roll"] == changes(page)["p_roll"][1]


def test_an_ardupilot_log_of_pitch(page, data):
    drop(page, data / "ardupilot_firmware" / "rate_chirp_pitch.BIN")
    assert light(page, "pitch")[0] in ("good", "warn", "bad")
    files_are_there(page)
    revert = assigned(saved(page, "Back to what flew"))
    assert any(name.startswith("ATC_RAT_") for name in revert)


def test_a_hover_says_what_to_fly(page, data, tmp_path):
    drop(page, data / "betaflight_firmware" / "A_hover.BFL")
    for axis in ("roll", "pitch", "yaw"):
        kind, sentence = light(page, axis)
        assert kind in ("warn", "bad") and "recipe" in sentence
        assert f"You did not move {axis}" in sentence
    page.get_by_role("button", name="What to fly, yaw").click()
    is_at(page, "recipe")
    page.get_by_text("chirp_amplitude_roll = 0").wait_for(timeout=LATE)
    page.get_by_label("firmware").click()
    page.get_by_role("option", name="ArduPilot").click()
    page.get_by_text("SID_AXIS,").first.wait_for(timeout=LATE)
    answer = recipe("ardupilot", "yaw")
    for name, text in zip(("yaw", "yaw_back"), answer.load, strict=True):
        with page.expect_download() as download:
            page.get_by_role("button", name=f"Download ardupilot_{name}.param").click()
        assert download.value.suggested_filename == f"ardupilot_{name}.param"
        assert Path(download.value.path()).read_text() == text

    # What is no log costs no result, and its message goes with the tab.
    page.get_by_role("tab", name="Tune").click()
    nonsense = tmp_path / "nonsense.bin"
    nonsense.write_bytes(b"milk, eggs")
    drop(page, nonsense)
    page.locator(".error", has_text="nonsense.bin").wait_for(timeout=LATE)
    assert light(page, "roll")[0] in ("warn", "bad")
    page.get_by_role("tab", name="Compare").click()
    page.locator(".error").wait_for(state="detached")


def test_channels_of_a_table_are_chosen_and_identified(page, tmp_path):
    log = write_demo_log(tmp_path / "bench <b>one</b>.csv")
    drop(page, log)
    page.get_by_text("Choose what moves the vehicle").wait_for(timeout=LATE)
    for label, name in (("input", "M ("), ("output", "q ("), ("reference", "x0 (")):
        page.get_by_label(label, exact=True).click()
        page.get_by_role("option", name=name).click()
    page.locator(".js-plotly-plot .main-svg").first.wait_for(timeout=LATE)
    page.get_by_text("All settings").click()
    page.get_by_label("rate", exact=True).fill("fast")
    page.get_by_role("button", name="Identify", exact=True).click()
    page.get_by_text("`rate` is 'fast'").wait_for(timeout=LATE)
    page.get_by_label("rate", exact=True).fill("250")
    page.get_by_role("button", name="Identify", exact=True).click()
    page.get_by_text("The record determines the model").wait_for(timeout=LATE)
    assert "gain" in page.inner_text(".code")
    assert page.locator("main b").count() == 0  # the file's name is a text


def test_a_task_is_cancelled_or_gives_way_to_another_log(page, data):
    drop(page, data / "betaflight_firmware" / "B_chirp_three_axes.BFL")
    page.locator(".js-plotly-plot .main-svg").first.wait_for(timeout=LATE)
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("cancelled").wait_for(timeout=LATE)
    drop(page, data / "betaflight_firmware" / "B_chirp_three_axes.BFL")
    page.locator("article.light", has_text="is not there yet").first.wait_for(timeout=LATE)
    drop(page, data / "betaflight_firmware" / "A_doublets.BFL")
    page.locator("h2", has_text="A_doublets").wait_for(timeout=LATE)
    assert light(page, "roll")[0] in ("good", "warn", "bad")


def test_tabs_have_nothing_in_common(page, browser, address, data):
    drop(page, data / "betaflight_firmware" / "A_hover.BFL")
    page.locator("h2", has_text="A_hover").wait_for(timeout=LATE)
    other = browser.new_page()
    other.goto(address)
    other.wait_for_selector("h1")
    time.sleep(1)
    assert "A_hover" not in other.inner_text("body")
    other.close()
    assert "A_hover" in page.inner_text("body")


@pytest.mark.parametrize("name", ["cut.BFL", "noise.bin", "empty.csv"])
def test_a_damaged_log_has_one_message(page, data, tmp_path, name):
    path = tmp_path / name
    if name == "cut.BFL":  # in the middle of its headers
        path.write_bytes((data / "betaflight_firmware" / "A_hover.BFL").read_bytes()[:900])
    else:
        noise = np.random.default_rng(0).bytes(4000) if name == "noise.bin" else b""
        path.write_bytes(noise)
    drop(page, path)
    page.locator(".error").wait_for(timeout=LATE)
    assert name in page.inner_text(".error") and "/jaxquad-app" not in page.inner_text(".error")
    assert "Traceback" not in page.inner_text("body")


def test_names_of_a_log_are_texts(page, tmp_path):
    alert = "<img src=x onerror=alert(1)>"
    page.on("dialog", lambda dialog: pytest.fail("a name of the log ran as a script"))
    time_s = np.arange(0, 10, 0.01)
    rows = np.stack([time_s, np.sin(time_s), np.cos(time_s)], axis=1)
    path = tmp_path / "names.csv"
    np.savetxt(path, rows, delimiter=",", header=f"time,{alert},q", comments="")
    drop(page, path)
    page.get_by_label("input", exact=True).click()
    page.get_by_role("option", name="onerror").click()
    page.locator(".js-plotly-plot .main-svg").first.wait_for(timeout=LATE)
    assert page.locator("img[src=x]").count() == 0


ROLES = {"button", "link", "textbox", "combobox", "option", "slider", "checkbox", "switch", "tab"}


def controls(tab) -> list[tuple[str, str]]:
    """Role and accessible name of what mouse or keyboard use, as Chromium tells screen readers."""
    browser, listed = tab.context.new_cdp_session(tab), []
    for node in browser.send("Accessibility.getFullAXTree")["nodes"]:
        place = {"backendNodeId": node.get("backendDOMNodeId")}
        if node["ignored"] or node["role"]["value"] == "RootWebArea" or None in place.values():
            continue
        role, name = node["role"]["value"], node.get("name", {}).get("value", "")
        facts = {x["name"]: x["value"].get("value") for x in node.get("properties", [])}
        attributes = browser.send("DOM.describeNode", place)["node"].get("attributes", [])
        pairs = dict(zip(attributes[::2], attributes[1::2], strict=True))
        reached = facts.get("focusable") and pairs.get("tabindex") != "-1"
        if role in ROLES or reached:
            listed.append((role, name.strip()))
    browser.detach()
    return listed


def test_each_control_has_a_name_for_screen_readers(page, data):
    shown = controls(page)
    drop(page, data / "betaflight_firmware" / "A_chirp_roll.BFL")
    files_are_there(page)
    page.get_by_role("button", name="Response and model, roll").click()
    page.locator("h3", has_text="roll: response and model").wait_for(timeout=LATE)
    page.get_by_text("All settings").click()
    page.get_by_label("sensitivity").wait_for()
    shown += controls(page)
    names = {name for role, name in shown if role == "slider"}
    assert {"start of the range, s", "end of the range, s"} < names and len(names) == 4
    # What a reader says of an end is where it stands, also after it was moved.
    start = page.get_by_role("slider", name="start of the range, s")
    before = float(start.get_attribute("aria-valuenow"))
    start.press("ArrowRight")
    page.get_by_text(f"used: {before + 0.01:.2f} to").wait_for(timeout=LATE)
    assert float(start.get_attribute("aria-valuenow")) == pytest.approx(before + 0.01)
    for tab in ("Compare", "What to fly"):
        page.get_by_role("tab", name=tab).click()
        page.locator("h2", has_text="Two flights" if tab == "Compare" else "What to fly").wait_for()
        shown += controls(page) if tab == "Compare" else []
    page.get_by_text("set chirp_amplitude_yaw = 150").wait_for()  # of the log's firmware
    page.get_by_label("firmware").click()
    page.get_by_role("option", name="PX4").wait_for()
    shown += controls(page)
    assert {role for role, _ in shown} >= ROLES - {"checkbox"}
    assert [role for role, name in shown if not name] == []


DRAWN = "[...document.querySelectorAll('.js-plotly-plot')].find(x => x.data?.length)?.data[0]"


def test_a_million_samples_zoom_without_a_wait(page, tmp_path):
    time_s = np.arange(4_400_000) / 1000.0  # three columns: 106 MB
    spike = np.sin(time_s)
    spike[1_234_567] = 50.0
    path = tmp_path / "long.npz"
    np.savez(path, time=time_s, M=spike, q=np.cos(time_s))
    drop(page, path)
    page.get_by_label("input", exact=True).click(timeout=LATE)
    page.get_by_role("option", name="M (").click()
    page.wait_for_function(DRAWN, timeout=LATE)
    assert page.evaluate(f"Math.max(...{DRAWN}.y)") == 50.0  # what is drawn keeps the extremes
    assert page.evaluate(f"{DRAWN}.x.length") <= 2002
    box = page.locator(".nsewdrag").first.bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.4 * box["width"], middle, steps=4)
    start = time.perf_counter()
    page.mouse.up()
    page.wait_for_function(f"{DRAWN}.x.at(-1) < 2000", timeout=LATE)
    assert time.perf_counter() - start < 10
    assert 500 < page.evaluate(f"{DRAWN}.x.length") <= 2002  # drawn anew, as densely


def test_two_flights_are_compared(page, data):
    page.get_by_role("tab", name="Compare").click()
    page.get_by_text("Two flights over each other").wait_for()  # the box of the other tab is gone
    folder = data / "betaflight_firmware"
    for k, name in enumerate(("A_chirp_roll.BFL", "A_chirp_plain.BFL")):
        page.set_input_files(f"input[type=file] >> nth={k}", str(folder / name))
        page.get_by_text(f": {name}").wait_for(timeout=LATE)
    page.get_by_role("link", name="The comparison as one page").wait_for(timeout=LATE)
    lights = page.locator("article.light h3").all_inner_texts()
    assert lights == ["roll: the same", "pitch: cannot tell", "yaw: cannot tell"]  # gains
    assert "you did not move yaw" in page.locator("article.light").last.inner_text()
    is_at(page, "compare")


def drag(tab, path: Path, x: float, y: float) -> None:
    """As a file manager does: the browser opens a file that no page takes."""
    mouse = tab.context.new_cdp_session(tab)
    data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        mouse.send("Input.dispatchDragEvent", {"type": kind, "x": x, "y": y, "data": data})


def test_a_file_that_is_dropped_beside_a_box_is_taken_by_the_nearest(page, tmp_path):
    log, address = write_demo_log(tmp_path / "demo.csv"), page.url
    page.get_by_role("tab", name="What to fly").click()
    page.get_by_text("What to fly, so that").wait_for()
    drag(page, log, 640, 700)  # no box is here
    page.get_by_role("tab", name="Compare").click()
    page.get_by_text("Drop the log after").wait_for()
    drag(page, log, 700, 860)
    page.get_by_text("after: demo.csv").wait_for(timeout=LATE)
    assert page.get_by_text("before: demo.csv").count() == 0
    page.get_by_role("tab", name="Tune").click()
    page.get_by_text("Drop the log here").wait_for()
    drag(page, log, 1270, 10)
    page.locator("h2", has_text="demo.csv").wait_for(timeout=LATE)
    is_at(page, "log")
    assert page.url == address and page.locator(".dragged").count() == 0


@pytest.mark.parametrize("moved", [False, True])
def test_who_reads_elsewhere_or_wants_no_motion_is_not_moved(page, moved):
    page.emulate_media(reduced_motion="reduce")
    page.evaluate(
        "() => { Element.prototype.scrollIntoView = x => { window.motion = x.behavior } }"
    )
    page.get_by_role("button", name="Try a simulated flight").click()
    if moved:
        page.get_by_role("button", name="Cancel").wait_for()
        page.keyboard.press("Tab")
    page.locator("h2#log").wait_for(timeout=LATE)
    page.wait_for_timeout(300)
    assert page.evaluate("window.motion") == (None if moved else "instant")


def test_several_logs_are_a_batch(page, tmp_path):
    logs = [write_demo_log(tmp_path / f"{k}.csv", seed=k) for k in range(2)]
    page.set_input_files("input[type=file] >> nth=0", list(map(str, logs)))
    page.get_by_role("link", name="The table (CSV)").wait_for(timeout=LATE)
    assert saved(page, "The table (CSV)").count(".csv") >= 2


def test_the_server_ends_after_its_last_tab_and_leaves_no_file(browser, tmp_path):
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(temporary))
        with served(tmp_path, "--linger", "2") as (address, process):
            tab = browser.new_page()
            tab.goto(address)
            tab.wait_for_selector("h1")
            drop(tab, write_demo_log(tmp_path / "demo.csv"))
            tab.get_by_text("Choose what moves").wait_for(timeout=LATE)
            assert any(temporary.rglob("demo.csv"))
            tab.reload()
            tab.get_by_text("Choose what moves").wait_for(timeout=LATE)
            tab.close()
            assert process.wait(60) == 0
    assert [path for path in temporary.rglob("*") if path.is_file()] == []
