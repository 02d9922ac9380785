"""``python -m rig.workbench.live FOLDER --fd N``: the page, as `--live` starts it."""

from __future__ import annotations

import argparse
import os
import pathlib
import socket

from rig.workbench.live.launch import TOKEN
from rig.workbench.live.server import serve

LINGER_S = 600.0  # after the session's end and the last look of a browser


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m rig.workbench.live")
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--fd", type=int, required=True, help="a listening socket")
    args = parser.parse_args()
    token = os.environ.pop(TOKEN, "") or None
    serve(args.folder, socket.socket(fileno=args.fd), token, LINGER_S)


if __name__ == "__main__":
    main()
