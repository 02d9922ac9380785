"""The live page in headless Chromium, while real sessions run against the simulator.

The simulator lives here; session and page are processes of their own, as in use.
"""

import contextlib
import http.server
import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import harness
import numpy as np
import pytest
from harness import changed, fast_text, free_port, simulator

from rig.config import parse_config
from rig.journal.run_folder import read_journal
from rig_workbench import live
from rig_workbench.live import draw

pytest.importorskip("nicegui")
webdriver = pytest.importorskip("selenium.webdriver")
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (BROWSER and DRIVER), reason="needs chromium and its driver"
    ),
]
PATIENT_S = 60.0  # this computer may draw the scenes in software
PATIENT = {"stale_s = 1.0": "stale_s = 8", "timeout_s = 0.5": "timeout_s = 3"}
BRISK = PATIENT | {
    "speed_deg_s = 400": "speed_deg_s = 40",
    "samples = 5": "samples = 50",
}
SLOW = PATIENT | {"speed_deg_s = 400": "speed_deg_s = 2"}  # minutes, to step in
# Angles in degrees of the chains in the scene of the device: device, then ghost.
CHAINS = """
const found = {};
for (const key of Object.keys(window).filter((k) => k.startsWith("scene_c")))
  for (let group of window[key].children.filter((c) => c.type === "Group")) {
    const chain = (found[group.name] = []);
    while (group) {
      chain.push([group.rotation.x, group.rotation.y, group.rotation.z]);
      group = group.children.find((c) => c.type === "Group");
    }
  }
return [found.device ?? [], found.ghost ?? []];
"""


class Rig:
    """A simulator, a session and a page; what is left of them is ended at the end."""

    def __init__(self, folder):
        self.folder = folder / "run"
        self.folder.mkdir()
        self.sim = self.session = None
        sock = socket.create_server(("127.0.0.1", 0))
        self.port = sock.getsockname()[1]
        with sock:
            command = [sys.executable, "-m", "rig", "watch", str(self.folder)]
            self.page = subprocess.Popen(
                [*command, "--socket", str(sock.fileno())], pass_fds=[sock.fileno()]
            )
        self.url = f"http://127.0.0.1:{self.port}/"

    def start(self, changes):
        config = parse_config(fast_text(changes))
        self.sim = simulator(config)
        served = self.sim.start()
        bus, imu = changed(served.bus), changed(served.imu, port=free_port())
        text = fast_text(changes)
        text = text.replace("port = 5020", f"port = {bus.port}")
        text = text.replace("port = 2055", f"port = {imu.port}")
        path = self.folder / "rig.toml"
        path.write_text(text)
        self.sim.start_phone(imu.port)
        command = [sys.executable, harness.__file__, str(self.folder), str(path)]
        self.session = subprocess.Popen([*command, "none", "none"])
        until(lambda: len(self.records("visit")) >= 1)
        return self

    def records(self, event):
        path = self.folder / "journal.jsonl"
        records = read_journal(path) if path.exists() else []
        return [record for record in records if record["event"] == event]

    def close(self):
        for process in (self.session, self.page):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()
        if self.sim is not None:
            self.sim.close()


def until(true, seconds=PATIENT_S):
    """Wait for something; returns what it came to."""
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, "it did not come to that in time"
        time.sleep(0.05)
    return found


def open_browser(width=1100, height=800):
    """Headless Chromium, which draws the scenes in software."""
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    size = f"--window-size={width},{height}"
    software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    for flag in ("--headless=new", "--no-sandbox", size, *software):
        options.add_argument(flag)
    service = webdriver.ChromeService(DRIVER)
    return webdriver.Chrome(options=options, service=service)


@pytest.fixture
def rig(tmp_path):
    with contextlib.closing(Rig(tmp_path)) as made:
        yield made


@pytest.fixture
def browse():
    """A function that opens browsers of a size."""
    opened = []

    def browser(rig=None, width=1100, height=800, pace=SLOW, url=""):
        """Opened first: a browser takes longer to start than a short session runs."""
        driver = open_browser(width, height)
        opened.append(driver)
        if width < 500:
            metrics = {"width": width, "height": height, "deviceScaleFactor": 2}
            driver.execute_cdp_cmd(
                "Emulation.setDeviceMetricsOverride", metrics | {"mobile": True}
            )
        if rig and pace and rig.session is None:
            rig.start(pace)
        driver.get(url or rig.url)
        return driver

    yield browser
    for driver in opened:
        driver.quit()


@pytest.fixture
def browse_alone(browse):
    """The bar with STOP by itself, and an event until which its server is silent."""
    release, folder = threading.Event(), pathlib.Path(live.__file__).parent
    body = draw("body", head="<p class=now></p>", here=True)
    page = f"""<!doctype html><link rel=stylesheet href=page.css>{body}
        <script src=page.js></script>"""

    class Silent(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            path = folder / self.path.lstrip("/")
            self.send_response(200)
            self.end_headers()
            self.wfile.write(path.read_bytes() if path.is_file() else page.encode())

        def do_POST(self):
            release.wait()
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"STOPPED: pitch")

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Silent) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        try:
            yield browse(url=f"http://127.0.0.1:{site.server_port}/"), release
        finally:
            release.set()
            site.shutdown()


def words(driver, selector):
    """What stands in an element, empty where there is none."""
    found = "const found = document.querySelector(arguments[0]);"
    return driver.execute_script(found + "return found?.innerText ?? ''", selector)


def shown(driver, selector):
    found = "const found = document.querySelector(arguments[0]);"
    return driver.execute_script(found + "return !!found?.checkVisibility()", selector)


def test_the_device_follows_the_phone_and_the_ghost_the_command(rig, browse):
    driver = browse(rig)
    until(lambda: [len(c) for c in driver.execute_script(CHAINS)] == [3, 3])
    seen = []
    while rig.session.poll() is None and len(seen) < 40:
        seen.append(driver.execute_script(CHAINS))
        time.sleep(0.2)
    turned = np.degrees(np.array(seen))  # (N, 2 chains, 3 groups, 3 of Euler)
    # Order ZXY: yaw about z, pitch about x, roll about y, and nothing else.
    angles = turned[:, :, [1, 0, 2], [0, 2, 1]]
    np.testing.assert_allclose(np.abs(turned).sum(axis=(2, 3)), np.abs(angles).sum(2))
    lines = (rig.folder / "telemetry.jsonl").read_text().splitlines()
    known = np.array([s["deg"] for s in map(json.loads, lines) if "deg" in s])
    apart = np.abs(angles[:, 0, None] - known).max(axis=2).min(axis=1)
    assert np.median(apart) < 1e-3 and (apart < 1e-3).mean() > 0.7  # not in between
    assert np.ptp(angles[:, 0], axis=0).min() > 3.0
    scale = parse_config(fast_text(SLOW)).to_deg
    asked = np.array([scale(r["pulses"]) for r in rig.records("visit")])
    late = angles[2:, 1]  # the first may be the zero posture
    assert np.abs(late[:, None] - asked).max(axis=2).min(axis=1).max() < 1e-3


def test_stop_stops_all_drives(rig, browse):
    driver = browse(rig)
    until(lambda: shown(driver, "#stop"))
    driver.find_element("id", "stop").click()
    assert rig.session.wait(PATIENT_S) == 128 + signal.SIGTERM
    [stop] = rig.records("stop")[-1:]
    assert [unit["acknowledged"] for unit in stop["units"]] == [True] * 3
    assert [unit["standing"] for unit in stop["units"]] == [True] * 3
    there = [drive.position for drive in rig.sim.drives]
    time.sleep(0.3)
    assert [drive.position for drive in rig.sim.drives] == there
    until(lambda: words(driver, "#head .now") == "Stopped on request")
    until(lambda: not shown(driver, "#stop"))
    told = words(driver, ".trouble")
    assert "pitch (unit 1): acknowledged, standing" in told
    assert "jaxcal-rig resume" in told


# Clicks STOP. For each frame after: its time and what "NO ANSWER" shows, in ms since
# the click; what the page answers, and when.
CLICK = """
const [answer, late] = ["answer", "late"].map((id) => document.getElementById(id));
window.frames_ = [];
window.answers = [];
document.getElementById("stop").addEventListener("click", (click) => {
  const note = () => {
    const [silence] = late.getAnimations(), timing = silence?.effect.getTiming();
    const shown = Number(getComputedStyle(late).opacity);
    const due = silence ? silence.startTime + timing.delay - click.timeStamp : null;
    window.frames_.push([document.timeline.currentTime - click.timeStamp, shown, due]);
    requestAnimationFrame(note);
  };
  requestAnimationFrame(note);
  new MutationObserver(() => window.answers.push(
    [performance.now() - click.timeStamp, answer.className, answer.textContent]
  )).observe(answer, { childList: true, attributes: true, subtree: true });
});
document.getElementById("stop").click();
"""


def no_answer(driver):
    """Every frame shows NO ANSWER from a second after the click on, and none before."""
    frames = driver.execute_script("return window.frames_")
    waiting = [frame for frame in frames if frame[2] is not None]
    assert {due for _, _, due in waiting} == {1000.0}
    for at, shown_, _ in waiting:
        assert shown_ == (at >= 1000.5) or 999.5 < at < 1001.5, (at, shown_)
    return [at for at, shown_, _ in waiting if shown_ == 1]


def test_no_answer_is_shown_a_second_after_the_click(browse_alone):
    """By the browser's own clock: the server holds its answer until it was seen."""
    driver, release = browse_alone
    driver.execute_script(CLICK)
    until(lambda: "NO ANSWER: use the emergency stop" in words(driver, "#answer"))
    assert no_answer(driver)
    assert driver.find_element("id", "answer").get_attribute("class") == "bad"
    release.set()
    until(lambda: words(driver, "#answer") == "STOPPED: pitch")
    assert driver.find_element("id", "answer").get_attribute("class") == "good"
    until(lambda: driver.execute_script("return window.frames_.at(-1)[1]") == 0)


def test_a_stop_without_an_answer_is_red_until_it_comes(rig, browse):
    """C: the page said "STOP sent", and nothing stopped."""
    driver = browse(rig)
    until(lambda: shown(driver, "#stop"))
    rig.page.send_signal(signal.SIGSTOP)
    driver.execute_script(CLICK)
    until(lambda: "NO ANSWER: use the emergency stop" in words(driver, "#answer"))
    assert no_answer(driver)
    assert driver.find_element("id", "answer").get_attribute("class") == "bad"
    rig.page.send_signal(signal.SIGCONT)
    until(lambda: words(driver, "#answer").startswith("STOPPED: pitch"))
    assert driver.find_element("id", "answer").get_attribute("class") == "good"


@pytest.mark.parametrize("suspended", [False, True])
def test_stopped_comes_from_the_drives_and_a_suspended_session_is_red_meanwhile(
    rig, browse, suspended
):
    driver = browse(rig)
    until(lambda: shown(driver, "#stop"))
    if suspended:
        rig.session.send_signal(signal.SIGSTOP)
    driver.execute_script(CLICK)
    until(lambda: words(driver, "#answer").startswith("STOPPED: pitch"))
    no_answer(driver)
    *seen, (_, look, _) = driver.execute_script("return window.answers")
    assert look == "good"
    assert all(at >= 999.0 for at, look, _ in seen if look == "bad")
    assert not any(drive.moving for drive in rig.sim.drives)
    code = -signal.SIGKILL if suspended else 128 + signal.SIGTERM
    assert rig.session.wait(PATIENT_S) == code


def test_pause_lets_the_posture_be_finished(rig, browse):
    driver = browse(rig)
    until(lambda: shown(driver, "#pause"))
    driver.find_element("id", "pause").click()
    until(lambda: "pause requested" in words(driver, "#answer"))
    driver.find_element("id", "pause").click()  # and no stop
    assert rig.session.wait(PATIENT_S) == 4
    visits = rig.records("visit")
    assert rig.records("posture")[-1]["name"] == visits[-1]["name"]
    until(lambda: words(driver, "#head .now") == "Paused")


def test_a_reload_in_the_middle_shows_the_same_run(rig, browse):
    driver = browse(rig)
    until(lambda: words(driver, "#head .now").startswith(("Moving", "Meas", "Wait")))
    until(lambda: driver.find_elements("css selector", ".queue .done"))
    driver.refresh()
    until(lambda: driver.find_elements("css selector", ".queue .done"))
    until(lambda: [len(c) for c in driver.execute_script(CHAINS)] == [3, 3])
    assert shown(driver, "#stop")
    count = len(rig.records("posture"))
    done = "return document.querySelectorAll('.queue .done').length"
    until(lambda: driver.execute_script(done) > count)


def test_a_page_that_is_killed_costs_the_session_nothing(rig, browse):
    driver = browse(rig, pace=BRISK)
    until(lambda: shown(driver, "#stop"))
    rig.page.kill()
    rig.page.wait()
    driver.find_element("id", "stop").click()
    until(lambda: "NOT SENT" in words(driver, "#answer"))
    assert "emergency stop" in words(driver, "#answer")
    assert rig.session.wait(PATIENT_S) == 0
    assert rig.records("end")[0]["code"] == 0


def test_two_browsers_see_the_same_and_either_stops(rig, browse):
    first = browse(rig, pace=None)
    second = browse(rig, width=700, height=600, pace=None)
    rig.start(SLOW)
    for driver in (first, second):
        until(lambda driver=driver: shown(driver, "#stop"))
        until(lambda driver=driver: words(driver, ".queue li"))
    second.find_element("id", "stop").click()
    assert rig.session.wait(PATIENT_S) == 128 + signal.SIGTERM
    for driver in (first, second):
        until(lambda driver=driver: words(driver, "#head .now") == "Stopped on request")


HOSTILE = """
<script>
window.results = {};
const socket = new WebSocket("ws://TARGET/_nicegui_ws/socket.io/?EIO=4&transport=websocket");
socket.onopen = () => (window.results.socket = "open");
socket.onerror = () => (window.results.socket = "refused");
fetch("http://TARGET/stop", { method: "POST", mode: "no-cors" })
  .finally(() => (window.results.stop = "tried"));
</script>
<iframe src="http://TARGET/"></iframe>
"""


def test_another_site_in_the_same_browser_reaches_nothing(rig, browse):
    driver = browse(rig)  # so that the browser knows the page
    until(lambda: shown(driver, "#stop"))
    text = HOSTILE.replace("TARGET", f"127.0.0.1:{rig.port}").encode()

    class Site(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        driver.get(f"http://127.0.0.1:{site.server_port}/")
        found = until(
            lambda: len(r := driver.execute_script("return window.results")) == 2 and r
        )
        driver.get(f"http://localhost:{site.server_port}/")  # another host, too
        until(lambda: len(driver.execute_script("return window.results")) == 2)
        site.shutdown()
    assert found["socket"] == "refused"
    count = len(rig.records("posture"))
    until(lambda: len(rig.records("posture")) > count)  # the session goes on
    assert rig.session.poll() is None and not rig.records("stop")


def test_a_finished_run_has_its_verdict_and_no_buttons(rig, browse):
    assert rig.start(BRISK).session.wait(PATIENT_S) == 0
    driver = browse(rig)
    until(lambda: words(driver, "#head .now") == "Done")
    assert not shown(driver, "#stop") and not shown(driver, "#pause")
    until(lambda: "error before" in words(driver, ".verdict").lower())
    states = "return [...document.querySelectorAll('.queue .state')]"
    found = driver.execute_script(states + ".map((e) => e.innerText)")
    assert set(found) == {"done"}
    driver.get(driver.find_element("link text", "Full report").get_attribute("href"))
    assert "Calibration" in words(driver, "h1")
    own = f"http://127.0.0.1:{rig.port}/"
    driver.get(rig.url)
    until(lambda: words(driver, "#head .now") == "Done")
    loaded = driver.execute_script(
        "return performance.getEntriesByType('resource').map((r) => r.name)"
    )
    assert len(loaded) > 10
    foreign = [n for n in loaded if not n.startswith((own, "data:", "blob:"))]
    assert not foreign


@pytest.mark.parametrize(("width", "height"), [(360, 640), (390, 844), (1400, 900)])
def test_stop_is_in_sight_at_any_width(rig, browse, width, height):
    driver = browse(rig, width=width, height=height)
    until(lambda: shown(driver, "#stop"))
    until(lambda: words(driver, ".numbers"))
    for place in (0, 10**6):
        driver.execute_script(f"window.scrollTo(0, {place})")
        box = driver.execute_script(
            "const b = document.getElementById('stop').getBoundingClientRect();"
            "return [b.left, b.top, b.right, b.bottom, innerWidth, innerHeight]"
        )
        left, top, right, bottom, wide, high = box
        assert 0 <= left < right <= wide and 0 <= top < bottom <= high
        assert bottom - top >= 48 and right - left >= 120
    assert driver.execute_script("return document.documentElement.scrollWidth") <= wide


def test_a_session_starts_its_page_and_survives_its_death(tmp_path):
    """The command itself, with everything in it."""
    config = tmp_path / "rig.toml"
    config.write_text(fast_text(BRISK))
    command = [sys.executable, "-m", "rig", "calibrate", "--simulate", "--live"]
    command += ["--config", str(config), "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as made:
        line = next(line for line in made.stdout if line.startswith("live page: "))
        found = until(lambda: _pages(tmp_path))
        assert os.getpgid(found[0]) != os.getpgid(made.pid)
        assert line.split()[-1].startswith("http://127.0.0.1:")
        os.kill(found[0], signal.SIGKILL)
        made.stdout.read()  # ends with the session: the page does not hold it open
        assert made.wait(PATIENT_S) == 0


def _pages(folder):
    """Processes that are a live page of a run in a folder."""
    found = []
    for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = path.read_bytes().decode(errors="replace")
            if "\0watch\0" in words and str(folder) in words:
                found.append(int(path.parent.name))
    return found
