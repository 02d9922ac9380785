"""The paper's figures, tables and claims from our own runs, each beside the paper's.

``exhibits`` of one topic per module, drawn by ``figures``; ``claims`` judges what the
paper states; ``texts.toml`` holds what is said; ``page`` makes one HTML file of all.
``python -m jaxcal.paper`` runs it.
"""
