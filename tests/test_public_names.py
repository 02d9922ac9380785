"""How many names a user may learn: those of the doors, counted once each."""

import importlib

DOORS = (
    *("jaxcal", "jaxcal.models", "jaxcal.calibration", "jaxcal.selection"),
    *("jaxcal.designs", "jaxcal.arms", "jaxcal.adaptive"),
)
MOST = 60


def test_the_doors_show_few_names() -> None:
    names: set[str] = set()
    for door in DOORS:
        module = importlib.import_module(door)
        assert all(hasattr(module, name) for name in module.__all__), door
        names |= set(module.__all__)
    assert len(names) <= MOST, sorted(names)
