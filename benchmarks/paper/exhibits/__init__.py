"""The paper's figures, tables and claims from our own runs, each beside the paper's.

One topic per module: ``exhibits(study)`` computes and draws it. ``claims`` judges
what the paper states; ``texts.toml`` holds what is said; ``page`` makes one HTML file
of all. ``python -m benchmarks.paper`` runs it.
"""
