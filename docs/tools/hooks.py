"""What `mkdocs build` adds to docs/: generated reference pages, examples, figures."""

from __future__ import annotations

import importlib
import inspect
import os
import pathlib
import shutil
import sys
import tempfile
from typing import Any

import matplotlib
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(pathlib.Path(__file__).parent)]

import figures
import pictures
import reference

PUBLIC = (
    "jaxcal",
    "jaxcal.models",
    "jaxcal.selection",
    "jaxcal.designs",
    "jaxcal.calibration",
    "jaxcal.arms",
    "jaxcal.tables",
    "jaxcal.adaptive",
    "jaxcal.learning",
    "jaxcal.candidates",
    "jaxcal.evaluation",
    "jaxcal.reports.plots",
)
FIRST = {  # what a page begins with; the rest follows in the order of the alphabet
    "jaxcal": ("select", "Design", "Selection", "identify", "Calibration"),
    "jaxcal.calibration": ("identify", "Calibration"),
    "jaxcal.selection": ("select", "Design", "Selection"),
    "jaxcal.models": ("Affine", "Linear", "Polynomial", "FromJax"),
    "jaxcal.arms": ("SerialChain", "Chains"),
    "jaxcal.tables": ("read_table", "Table"),
    "jaxcal.learning": (
        *("make_train", "preset", "reset", "step", "observe", "start"),
        *("SelectionConfig", "SelectionState", "Task", "Postures", "Network"),
    ),
}
CONSTANTS = (str, int, float, tuple, dict)  # documented where they are defined


def undocumented(module_name: str) -> list[str]:
    """Public names of a module and members of its classes that have no docstring."""
    module = importlib.import_module(module_name)
    if not module.__doc__:
        return [module_name]
    found = []
    for name in module.__all__:
        value = getattr(module, name)
        if isinstance(value, CONSTANTS):
            continue
        if not inspect.getdoc(value):
            found.append(f"{module_name}.{name}")
        if inspect.isclass(value):
            found += [
                f"{module_name}.{name}.{member}"
                for member, given in vars(value).items()
                if not member.startswith("_")
                and (inspect.isfunction(given) or isinstance(given, property))
                and not inspect.getdoc(getattr(value, member))
            ]
    return found


def api_page(module_name: str) -> str:
    """The page of one public module: every name of its ``__all__``."""
    module = importlib.import_module(module_name)
    lines = [f"# {module_name}", "", inspect.getdoc(module) or "", ""]
    first = FIRST.get(module_name, ())
    for name in (*first, *(name for name in module.__all__ if name not in first)):
        value = getattr(module, name)
        if isinstance(value, CONSTANTS):
            shown = ", ".join(f"`{each}`" for each in value)
            lines += [f"## {name}", "", shown, ""]
        else:
            lines += [f"::: {value.__module__}.{value.__name__}", ""]
    return "\n".join(lines)


def on_pre_build(config: Any) -> None:
    """Stop where a public name has no documentation; commands of pages are ours."""
    os.environ["PATH"] = f"{pathlib.Path(sys.executable).parent}:{os.environ['PATH']}"
    matplotlib.use("Agg")
    if bare := [name for module in PUBLIC for name in undocumented(module)]:
        raise PluginError(f"public names without a docstring: {', '.join(bare)}")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that no file of docs/ holds, and draw every figure anew."""

    def add(path: str, content: str | bytes) -> None:
        if old := files.get_file_from_path(path):
            files.remove(old)
        files.append(File.generated(config, path, content=content))

    for module in PUBLIC:
        add(f"reference/{module}.md", api_page(module))
    add("reference/commands.md", reference.commands())
    add("reference/configuration.md", reference.configuration())
    add("benchmarks/table.md", figures.report.table(figures.benchmarks()))
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        text = text.replace("[code of conduct](CODE_OF_CONDUCT.md)", "code of conduct")
        add(name, text.replace("](docs/", "]("))
    for page in sorted((ROOT / "examples").glob("*.md")):
        text = page.read_text(encoding="utf-8").replace("](../docs/", "](../")
        script = page.with_suffix(".py").read_text(encoding="utf-8")
        add(f"examples/{page.name}", f"{text}\n## The script\n\n```py\n{script}```\n")
    for path, image in figures.draw_all().items():
        add(path, image)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Code runs in a folder of its own; the home page shows README's table."""
    if "/" not in page.file.src_uri:
        markdown = markdown.replace("](../examples/", "](examples/")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme.partition("<!-- figures -->")[2].partition("<!-- end -->")[0]
    table = table.replace("](docs/", "](")
    place = pathlib.Path(tempfile.mkdtemp())
    (place / "examples").symlink_to(ROOT / "examples")
    os.chdir(place)
    markdown = markdown.replace("<!-- figures of README -->", table)
    return pictures.executed(markdown, page.file.src_uri)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Back from the page's folder."""
    place = pathlib.Path.cwd()
    os.chdir(ROOT)
    shutil.rmtree(place)
    return html


def on_post_page(output: str, page: Any, config: Any) -> str:
    """The theme's only script from elsewhere gives way to docs/assets."""
    shim = page.url.count("/") * "../" + "assets/file_worker.js"
    return output.replace("https://unpkg.com/iframe-worker/shim", shim)
