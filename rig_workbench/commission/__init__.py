"""Commissioning by questions: a new rig.toml, then the steps of ``rig.prove``."""
