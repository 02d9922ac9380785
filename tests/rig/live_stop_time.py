"""How long the page's STOP takes: from the click to the last drive's stop frame.

    python tests/rig/live_stop_time.py [--sessions 10]

Each session runs in a process of its own against the simulator, with its page and one
headless Chromium; STOP is clicked while the drives move. The stop frames are stamped by
the simulated drives when they arrive.
"""

import argparse
import contextlib
import pathlib
import tempfile
import time

import numpy as np
from test_rig_live_browser import PATIENT, Rig, open_browser, shown, until

PACE = PATIENT | {"speed_deg_s = 400": "speed_deg_s = 6"}
CLICK = "document.getElementById('stop').click(); return Date.now()"


def measure(driver, folder):
    """Seconds from the click to the last of the three drives' first stop frames."""
    with contextlib.closing(Rig(folder).start(PACE)) as rig:
        driver.get(rig.url)
        until(lambda: shown(driver, "#stop"))
        until(lambda: any(drive.moving for drive in rig.sim.drives))
        time.sleep(0.5)
        offset = time.time() - time.monotonic()
        clicked = driver.execute_script(CLICK) / 1000.0 - offset
        rig.session.wait(60)
        return max(drive.stops[0] for drive in rig.sim.drives) - clicked


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=10)
    count = parser.parse_args().sessions
    taken = []
    driver = open_browser()
    try:
        for number in range(count):
            with tempfile.TemporaryDirectory() as folder:
                taken.append(measure(driver, pathlib.Path(folder)))
            print(f"session {number + 1}: {1e3 * taken[-1]:.0f} ms", flush=True)
    finally:
        driver.quit()
    found = 1e3 * np.array(taken)
    print(
        f"click to the last drive's stop frame, {count} sessions: median "
        f"{np.median(found):.0f} ms, worst {found.max():.0f} ms"
    )


if __name__ == "__main__":
    main()
