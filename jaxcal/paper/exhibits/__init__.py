"""The paper's figures, tables and claims from our own runs, each beside the paper's.

``exhibits`` of one topic a module; ``claims`` judges what the paper states; ``page``
makes one HTML file of all. ``python -m jaxcal.paper.reproduce`` runs it.
"""
