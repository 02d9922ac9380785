"""Names load on first use, whatever was imported before."""

import importlib
import pkgutil

import jaxcal.adaptive


def test_every_name_is_what_it_says_after_all_modules_are_imported():
    for module in pkgutil.iter_modules(jaxcal.adaptive.__path__, "jaxcal.adaptive."):
        if not module.name.endswith("brax_env"):
            importlib.import_module(module.name)
    for name in jaxcal.adaptive.__all__:
        assert callable(getattr(jaxcal.adaptive, name)), name
