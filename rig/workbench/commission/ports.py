"""What this computer can reach: serial ports, TCP addresses, its own addresses."""

from __future__ import annotations

import contextlib
import socket

TCP_TIMEOUT_S = 1.0
MODBUS_PORT = 502


def serial_lines() -> list[str]:
    """One line for each serial port: device, and what its adapter calls itself."""
    from serial.tools import list_ports  # type: ignore[import-untyped]  # no stubs

    lines = []
    for port in sorted(list_ports.comports()):
        usb = f", USB {port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
        maker = f", {port.manufacturer}" if port.manufacturer else ""
        lines.append(f"{port.device}: {port.description}{maker}{usb}")
    return lines


def tcp_line(host: str, port: int) -> tuple[bool, str]:
    """Whether something accepts connections at an address, and that in words."""
    where = f"{host}:{port}"
    try:
        with socket.create_connection((host, port), timeout=TCP_TIMEOUT_S):
            return True, f"{where}: accepts connections"
    except TimeoutError:
        return False, (
            f"{where}: no answer in {TCP_TIMEOUT_S:g} s. Check power, cable and address"
        )
    except OSError as error:
        return False, f"{where}: {error.strerror or error}"


def own_addresses() -> list[str]:
    """IPv4 addresses under which a phone can reach this computer."""
    found: dict[str, None] = {}
    # Connecting UDP sends nothing; it tells the address packets leave from.
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.connect(("192.0.2.1", 9))
        found[str(probe.getsockname()[0])] = None
    with contextlib.suppress(OSError):
        for *_, address in socket.getaddrinfo(socket.gethostname(), None):
            found[str(address[0])] = None
    return [a for a in found if ":" not in a and not a.startswith(("127.", "0."))]
