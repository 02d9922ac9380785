"""Every code block of the site and of README runs, or is parsed by its command."""

from __future__ import annotations

import contextlib
import io
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

import jax
import matplotlib
import pytest

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "tools"))

import rooms

PAGES = sorted(
    [*ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*.md"), *ROOT.glob("*.md")]
)
QUICK = {"calibration.md", "datasets.md", "evaluation.md", "own_function.md"}
RUN = {"candidates.md", "device.md"}  # their shell commands too are executed


def blocks(page: pathlib.Path) -> list[tuple[str, str]]:
    """(language, text) of each fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.M | re.S)


def commands(page: pathlib.Path) -> list[list[str]]:
    """Words of every command line, fenced or indented, without its comment."""
    whole = page.read_text().replace("\\\n", " ")  # lines that go on
    fenced = re.findall(r"^```\w*\n(.*?)^```", whole, re.M | re.S)
    lines = [line for text in fenced for line in text.splitlines()]
    lines += re.findall(r"^    (\S.*)$", whole, re.M)
    starts = ("jaxcal ", "jaxcal-rig ", "python ", "make ")
    printed = re.compile(r"jaxcal \w+: ")  # an error, not a command
    return [
        shlex.split(line, comments=True)
        for line in lines
        if line.startswith(starts) and not printed.match(line)
    ]


def with_code() -> list:
    pages = [
        page for page in PAGES if any(lang == "python" for lang, _ in blocks(page))
    ]
    return [
        pytest.param(page, id=str(page.relative_to(ROOT)),
                     marks=[] if page.name in QUICK else [pytest.mark.slow])
        for page in [*pages, ROOT / "docs" / "start" / "device.md"]
    ]  # fmt: skip


@pytest.mark.parametrize("page", with_code())
def test_the_blocks_of_a_page_run_in_their_order(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    shutil.copytree(ROOT / "examples" / "ur5", tmp_path / "examples" / "ur5")
    path = f"{pathlib.Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    names: dict[str, object] = {}
    printed, shown = "", []
    for language, text in blocks(page):
        if language == "python":
            out = io.StringIO()
            with jax.numpy_rank_promotion("allow"), contextlib.redirect_stdout(out):
                exec(compile(text, str(page), "exec"), names)
            printed += out.getvalue()
        elif language == "bash" and page.name in RUN:
            done = subprocess.run(
                ["bash", "-ec", text], env={**os.environ, "PATH": path},
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stdout + done.stderr
            printed += done.stdout
        elif language == "text":
            shown.append(text)
            for line in re.findall(r"^\$ .*\n", text, re.M):
                done = subprocess.run(
                    ["bash", "-c", line[2:]], env={**os.environ, "PATH": path},
                    capture_output=True, text=True, check=False,
                )  # fmt: skip
                printed += line + done.stdout + done.stderr
    if page.name in ("models.md", "arms.md", "arm.md", "candidates.md"):
        assert lines_of("".join(shown)) == lines_of(printed)


def lines_of(text: str) -> list[str]:
    """What is printed, less the time that a selection took, to nine digits."""
    return [
        re.sub(r"(\d\.\d{8})\d+", r"\1", line.rstrip())
        for line in text.splitlines()
        if line.strip() and not line.startswith("time ")
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_page_parse(page, capsys):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for words in commands(page):
        program, *rest = words
        given = " ".join(words)
        if program == "make":
            assert {w for w in rest if "=" not in w} <= targets, given
        elif program == "python" and rest[0] in ("-m", "-c"):
            assert rest[0] == "-c" or importable(rest[1]), given
        elif program == "python":
            assert (ROOT / rest[0]).is_file(), given
            if rest[0] in ("train.py", "evaluate.py"):
                parse(["jaxcal", rest[0][:-3], *rest[1:]])
        else:
            parse(words)


def importable(name: str) -> bool:
    import importlib.util

    return importlib.util.find_spec(name) is not None


def parse(words: list[str]) -> None:
    """Refused by exit code 2 where a flag or a value is wrong."""
    from jaxcal.commands.evaluate import parser as evaluate_parser
    from jaxcal.commands.program import _parser
    from jaxcal.commands.train_arguments import read as read_train
    from rig.commands import make_parser

    ends = [i for i, word in enumerate(words) if word in ("|", ">", "&&")]
    words = words[: min(ends, default=len(words))]
    program, name, *rest = words
    if program == "jaxcal-rig":
        make_parser().parse_args([name, *rest])
    elif name in ("train", "evaluate"):
        flags = [word for word in rest if word != "--help"]
        if name == "train":
            read_train(name, flags)
        elif "--task" not in rest:
            evaluate_parser(name, name).parse_args(flags)
    else:
        _parser([name]).parse_args([name, *rest])


def test_the_rooms_are_those_that_the_page_shows() -> None:
    """Rooms, floors and arrows as the imports have them, lines within 3 %."""
    page = (ROOT / "docs/architecture.md").read_text()
    counts = re.compile(r"(?<=\| )[\d,]+(?= \|)|[\d,]+(?= lines\.)")
    shown, drawn = page[page.index("| floor | room |") :], rooms.table()
    shown = shown[: shown.index(" lines.") + len(" lines.")]
    assert counts.sub("N", shown) == counts.sub("N", drawn)
    numbers = [
        [int(count.replace(",", "")) for count in counts.findall(text)]
        for text in (shown, drawn)
    ]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.03)
