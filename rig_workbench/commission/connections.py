"""What this computer reaches: serial ports, and a phone's stream, told in figures."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable

import numpy as np

from rig.config.settings import ImuSettings, ReadingsSettings
from rig.core.session import STREAM_WAIT_S
from rig.prove.steps import Site
from rig.readings import make_source
from rig.readings.geometry import Attitudes, Geometry, geometry_of
from rig.readings.phone import Imu
from rig.readings.source import Source

WATCH_S = 5.0
SHOWN = 300  # letters of a record
LOOK_S = 1.0
# Below these a session's settle window would hardly ever fill.
SLOW_HZ, LONG_GAP_S = 5.0, 0.3


def look_at_phone(site: Site, seconds: float = WATCH_S) -> str:
    """Wait for the phone and tell what it sends; its address."""
    config = site.config
    with make_source(config) as imu:
        site.say(
            f"imu: {place_text(config.source, imu.port)}; then start its "
            f"stream (waiting up to {STREAM_WAIT_S:g} s)"
        )
        for listener in site.listeners:
            listener({"event": "listening", "port": imu.port})
        geometry = geometry_of(config)
        watch(imu, geometry, seconds, STREAM_WAIT_S, site.say)
        if isinstance(imu, Imu):
            sent = imu.parser
            site.say(f"  it sends {sent.first[:SHOWN]}\n  read as {sent.taken_for}")
        return imu.sender


def place_text(settings: ImuSettings | ReadingsSettings, port: int) -> str:
    """What to type into the phone's app, or where a sensor's numbers come from."""
    place = f"{reached_at(settings.host)} port {port}"
    if settings.transport in ("listen", "udp"):
        if isinstance(settings, ImuSettings):
            return f"type into the phone's app ({settings.format}): {place}"
        return f"waiting for the sensor on {place}"
    return f"readings from {getattr(settings, 'device', '') or place}"


def watch(
    imu: Source,
    geometry: Geometry,
    seconds: float,
    wait_s: float,
    say: Callable[[str], None],
) -> None:
    """Wait for an open stream and look at it for so long, telling each second;
    ReadingError where nothing comes, or the stream is not to be trusted."""
    start, spent = imu.wait_for_stream(wait_s).time, 0.0
    while spent < seconds:
        time.sleep(min(LOOK_S, seconds - spent))
        imu.latest()
        readings, spent = imu.since(start), time.monotonic() - start
        gaps = np.diff([reading.time for reading in readings])
        values = [reading.value for reading in readings[-500:]]
        mean = geometry.mean(values)
        apart = [geometry.apart(mean, value) for value in values]
        scatter = float(np.sqrt(np.mean(np.square(apart)) / len(mean)))
        stands = "reads " + " ".join(f"{value:.6g}" for value in np.ravel(mean))
        if isinstance(geometry, Attitudes):
            tilt = np.degrees(np.arccos(np.clip(mean[2, 2], -1.0, 1.0)))
            stands = f"tilt {tilt:.1f} deg"
        dropped = [f"{n} {why}" for why, n in imu.counts.items() if why != "accepted"]
        rate, gap = len(readings) / spent, float(gaps.max(initial=0.0)) or spent
        say(
            f"  {rate:.0f} readings per s, longest gap {gap:.2f} s, scatter "
            f"{scatter:.3g}, {stands}, dropped: " + (", ".join(dropped) or "none")
        )
    if rate < SLOW_HZ or gap > LONG_GAP_S:
        say(
            f"  note: sessions need {SLOW_HZ:g} readings per s without gaps over "
            f"{LONG_GAP_S:g} s. {imu.lost}, raise its rate; or raise "
            f"{imu.table}.stale_s and settle.window_s"
        )


def reached_at(host: str) -> str:
    """IPv4 address under which a phone reaches what listens on ``host``."""
    if host not in ("0.0.0.0", "::"):
        return host
    # Connecting UDP sends nothing; it tells the address packets leave from.
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return "(this computer has no network address)"
