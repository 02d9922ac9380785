"""README's code runs, every command of a page parses, and pages are short."""

from __future__ import annotations

import pathlib
import re
import shlex
import sys

import common
import jax
import matplotlib.figure
import pytest

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "tools"))

import pictures
import rooms
import words as word_count

PAGES = sorted(
    [*ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*.md"), *ROOT.glob("*.md")]
)


def blocks(page: pathlib.Path) -> list[tuple[str, str]]:
    """(language, text) of each fenced block."""
    return re.findall(r"^```(\w*)[^\n]*\n(.*?)^```", page.read_text(), re.M | re.S)


def commands(page: pathlib.Path) -> list[list[str]]:
    """Words of every command line, fenced or indented, without its comment."""
    whole = page.read_text().replace("\\\n", " ")  # lines that go on
    fenced = re.findall(r"^```[^\n]*\n(.*?)^```", whole, re.M | re.S)
    lines = [line for text in fenced for line in text.splitlines()]
    lines += re.findall(r"^    (\S.*)$", whole, re.M)
    starts = ("jaxcal ", "jaxcal-rig ", "python ", "make ")
    printed = re.compile(r"jaxcal \w+: ")  # an error, not a command
    return [
        shlex.split(line, comments=True)
        for line in lines
        if line.startswith(starts) and not printed.match(line)
    ]


def test_the_code_of_the_readme_runs(tmp_path, monkeypatch):
    """Code of the other pages is run by the site's build, which ends at an error."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with jax.numpy_rank_promotion("allow"):
        for language, text in blocks(ROOT / "README.md"):
            if language == "python":
                exec(compile(text, "README.md", "exec"), names)
    assert (tmp_path / "best.png").stat().st_size > 1000


def test_a_block_is_run_and_its_picture_shown_once(tmp_path):
    page = "```python\nx = made()\nx.plot()  # two\n```\n\n```py\nnot_run()\n```\n"
    given = pictures.executed(page, "one.md")
    code = re.findall(r'exec="on".*?\n(.*?)^```', given, re.M | re.S)
    assert len(code) == 2 and code[0].startswith("x = made()\nx.plot()  # two\n")
    assert "# markdown-exec: hide" in code[0] and "not_run" not in "".join(code)

    class Made:
        def plot(self):
            return matplotlib.figure.Figure().subplots()

    names = {"made": Made}
    exec(code[0], names)
    assert pictures.drawn(names).count("<img") == 1
    assert pictures.drawn(names) == ""


def test_every_example_is_in_the_gallery_by_a_light_picture():
    page = (ROOT / "docs" / "gallery.md").read_text()
    for name in common.NAMES:
        picture = ROOT / "docs" / "assets" / "gallery" / f"{name}.webp"
        assert 1_000 < picture.stat().st_size < 40_000
        assert f"(assets/gallery/{name}.webp)" in page
        assert f"(../examples/{name}.md)" in page


def test_the_pages_have_at_most_forty_thousand_words():
    counted = word_count.counted()
    assert counted["README.md"] <= 1_200
    assert sum(counted.values()) <= 40_000
    assert {"docs/index.md", "examples/ur5.md", "CONTRIBUTING.md"} <= counted.keys()


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
    from jaxcal.commands.train_configuration import read as read_train
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
