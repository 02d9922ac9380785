"""The GCode drive against OctoPrint's virtual printer, on a pseudo-terminal.

    python -m venv /tmp/octo && /tmp/octo/bin/pip install OctoPrint
    python tests/rig/live_octoprint.py /tmp/octo/bin/python

OctoPrint stays in an environment of its own. Its printer answers M114 in words of its
own, which its settings turn into Marlin's; it is at its target at once, and does not
know M410, so that neither speed nor stop is tried.
"""

import pathlib
import subprocess
import sys
import tempfile

from other_drives import stage_text

from rig.config import parse_config
from rig.drives import make_drives

DRIVES = pathlib.Path(__file__).parents[2] / "examples" / "drives"
MARLIN = str(DRIVES / "marlin.toml")
PRINTER = """
import os, select, tempfile, threading, tty
from octoprint.plugins import virtual_printer
from octoprint.plugins.virtual_printer import virtual

class Settings:
    def get(self, path, **_):
        value = known
        for name in path:
            value = value[name]
        return value
    def get_int(self, path, **_): return int(self.get(path))
    def get_float(self, path, **_): return float(self.get(path))
    def get_boolean(self, path, **_): return bool(self.get(path))
    def global_get_basefolder(self, _): return tempfile.mkdtemp()

class NoPlugins:
    def get_hooks(self, *_): return {}

virtual.plugin_manager = NoPlugins
known = virtual_printer.VirtualPrinterPlugin().get_settings_defaults()
known |= {"simulated_errors": [], "sendWait": False, "enable_eeprom": False}
known["m114FormatString"] = "X:{x} Y:{y} Z:{z} Count X:{a} Y:{b} Z:{c}"
folder = tempfile.mkdtemp()
printer = virtual.VirtualPrinter(Settings(), None, folder, read_timeout=0.05)
ours, theirs = os.openpty()
tty.setraw(ours), tty.setraw(theirs)
print(os.ttyname(theirs), flush=True)

def answer():
    while True:
        if line := printer.readline():
            os.write(ours, line.rstrip() + b"\\n")

threading.Thread(target=answer, daemon=True).start()
while True:
    if select.select([ours], [], [], 1)[0]:
        printer.write(os.read(ours, 1024))
"""


def main(python):
    folder = pathlib.Path(tempfile.mkdtemp())
    (folder / "printer.py").write_text(PRINTER)
    command = [python, str(folder / "printer.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as printer:
        try:
            channel = printer.stdout.readline().strip()
            bus = f'transport = "serial"\ndevice = "{channel}"'
            config = parse_config(stage_text(bus, MARLIN, 1, 100))
            line, (x, y) = make_drives(config.bus, config.axes)
            x._scale = y._scale = 100.0  # counts for a millimetre, as this one counts
            with line:
                print(x.ids()["firmware"])
                x.arm()
                for drive, count in ((x, 500), (y, -300), (x, -1500)):
                    drive.move(count, 1000.0, 4000.0)
                    while drive.look(0).moving:
                        pass
                    assert drive.position() == count
                assert (x.position(), y.position()) == (-1500, -300)
            print("moves and positions of two axes agree")
        finally:
            printer.kill()


if __name__ == "__main__":
    main(sys.argv[1])
