"""The site: every public name documented, every page in a browser, opened as files."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import os
import pathlib
import re
import shutil
import subprocess
import sys
import types

import pytest

ROOT = pathlib.Path(__file__).parents[2]
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
SIZES = {"desktop": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="module")
def hooks():
    pytest.importorskip("mkdocs")
    sys.path.insert(0, str(ROOT / "docs" / "tools"))
    return importlib.import_module("hooks")


@pytest.mark.filterwarnings("ignore:JAXopt is no longer maintained")
def test_every_public_name_is_documented(hooks):
    assert [name for each in hooks.PUBLIC for name in hooks.undocumented(each)] == []


def test_every_key_of_the_rig_is_in_its_table(hooks):
    reference = importlib.import_module("reference")
    config = importlib.import_module("rig.config").RigConfig
    page = reference.table(config) + reference.table(config, advanced=True)
    axis = config.model_json_schema()["$defs"]["Axis"]["properties"]
    assert {name for name in axis if f"`axes.*.{name}`" not in page} == set()
    assert "`session.verify_limit_deg`" in page


def test_a_public_name_without_a_docstring_is_found(hooks, monkeypatch):
    module = types.ModuleType("bare", "A module.")

    class Told:
        """A class."""

        def method(self): ...

    module.function, module.Told = lambda: None, Told
    module.__all__ = ["Told", "function"]
    monkeypatch.setitem(sys.modules, "bare", module)
    assert hooks.undocumented("bare") == ["bare.Told.method", "bare.function"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_picture_of_the_live_page_moves(scheme):
    image = pytest.importorskip("PIL.Image")
    with image.open(ROOT / "docs" / "assets" / f"live_{scheme}.webp") as picture:
        assert picture.n_frames >= 12


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "-d", folder],
        cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    return folder


def public(value: type) -> set[str]:
    """Methods, properties and fields of a class that its page must show."""
    kinds = types.FunctionType, property, functools.cached_property, classmethod
    shown = {
        name
        for base in value.__mro__
        if base.__module__.startswith("jaxcal")
        for name, member in vars(base).items()
        if isinstance(member, kinds)
        and getattr(member, "__module__", "jaxcal").startswith("jaxcal")
    }
    if dataclasses.is_dataclass(value):
        of_flax = ("parent", "name") if hasattr(value, "apply") else ()
        named = {field.name for field in dataclasses.fields(value)}
        shown |= named.difference(of_flax)
    return {name for name in shown if not name.startswith("_")}


@pytest.mark.slow
def test_every_public_method_and_field_is_on_its_page(site, hooks):
    for module_name in hooks.PUBLIC:
        module = importlib.import_module(module_name)
        page = (site / "reference" / f"{module_name}.html").read_text()
        assert not re.search(r":(class|func|meth|mod):", page), module_name
        for name in module.__all__:
            value = getattr(module, name)
            if not inspect.isclass(value):
                continue
            path = f"{value.__module__}.{value.__name__}"
            missing = {m for m in public(value) if f'id="{path}.{m}"' not in page}
            assert not missing, (path, missing)
    page = (site / "reference" / "jaxcal.html").read_text()
    assert page.index('id="jaxcal.selection.design.select"') < page.index(
        'id="jaxcal.selection.criteria.As"'
    )
    for name in ("command_for", "save", "check", "verification", "verdict", "loss"):
        assert f'id="jaxcal.calibration.calibration.Calibration.{name}"' in page
    for name in ("plan", "fastest", "pareto"):
        assert f'id="jaxcal.selection.design.Design.{name}"' in page


@pytest.fixture
def browser():
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


PAGE = """
const links = [...document.querySelectorAll("a[href]")].map(a => a.href);
const images = [...document.images].filter(i => !(i.complete && i.naturalWidth));
const loaded = performance.getEntriesByType("resource").map(e => e.name);
return {
  links, ids: [...document.querySelectorAll("[id]")].map(e => e.id),
  broken: images.map(i => i.src), loaded,
  cut: [...document.querySelectorAll(".help code")].filter(
    e => e.scrollWidth > e.clientWidth + 1).map(e => e.textContent.slice(0, 40)),
  scrolled: [...document.querySelectorAll(
    ".md-typeset__scrollwrap, pre > code")]
    .filter(e => e.scrollWidth > e.clientWidth + 1)
    .map(e => e.className + e.textContent.trim().slice(0, 40)),
  wide: document.documentElement.scrollWidth - window.innerWidth,
};
"""
COLOUR = "return getComputedStyle(document.body).backgroundColor"


def brightness(colour: str) -> float:
    red, green, blue = colour.partition("(")[2].rstrip(")").split(",")[:3]
    return (float(red) + float(green) + float(blue)) / 765.0


@pytest.mark.slow
@pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and its driver")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_every_page_and_link(site, browser, scheme, size):
    from selenium.webdriver.support.ui import WebDriverWait

    browser.set_window_size(*SIZES[size])
    feature = {"name": "prefers-color-scheme", "value": scheme}
    width, height = SIZES[size]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
    )
    todo, seen = [(site / "index.html").as_uri()], {}

    def in_scheme(_):  # a busy browser emulates it a moment after the page was loaded
        light = brightness(browser.execute_script(COLOUR)) > 0.5
        return light == (scheme == "light")

    while todo:
        url = todo.pop()
        browser.get(url)
        WebDriverWait(browser, 60).until(in_scheme, url)
        page = seen[url] = browser.execute_script(PAGE)
        assert not page["broken"], (url, page["broken"])
        assert page["wide"] <= 0, (url, page["wide"])
        assert not page["cut"], (url, page["cut"])
        scrolled = [
            text
            for text in page["scrolled"]
            if size == "desktop" or text.startswith("md-typeset__scrollwrap")
        ]
        # Names of faults, NIST's six columns and long signatures scroll on a phone.
        few = any(name in url for name in ("fault_matrix", "nist", "/reference/"))
        assert not scrolled or (few and size == "phone"), (url, scrolled)
        outside = [name for name in page["loaded"] if name.startswith("http")]
        assert not outside, (url, outside)
        for link in page["links"]:
            target = link.partition("#")[0]
            if target.startswith("file:") and target not in {*seen, *todo}:
                if target.endswith(".html"):
                    todo.append(target)
                else:
                    assert (site / target.partition(site.name)[2][1:]).exists(), link
    assert len(seen) >= 45
    for url, page in seen.items():
        for link in page["links"]:
            target, _, fragment = link.partition("#")
            if fragment and target in seen:
                assert fragment in seen[target]["ids"] or fragment == "__skip", (
                    url,
                    link,
                )


@pytest.mark.slow
@pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and its driver")
def test_the_search_works_without_a_server(site, browser):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    browser.set_window_size(1400, 900)
    browser.get((site / "index.html").as_uri())
    field = browser.find_element(By.CSS_SELECTOR, "input.md-search__input")
    browser.execute_script("arguments[0].focus()", field)
    field.send_keys("backlash")
    place = ".md-search-result__item a"
    found = WebDriverWait(browser, 60).until(
        lambda _: browser.find_elements(By.CSS_SELECTOR, place)
    )
    assert any("backlash" in each.get_attribute("href") for each in found)
