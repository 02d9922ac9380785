"""Around ``rig``, which it uses by public names; rig imports nothing of it.

``commission`` (the wizard, and what the phone sends), ``live`` (the page), ``outputs``
(reports, exports, trend), ``refit``, ``simulator``; ``model`` and ``numbers`` are of
devices that are not an affine map measured by a phone. ``rig`` finds all of them by
entry points: ``jaxcal_rig.commands`` and ``jaxcal_rig.parts``.
"""
