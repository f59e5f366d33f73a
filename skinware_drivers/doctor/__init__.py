"""What may be wrong with a skin and with the machine that reads it: seen once, judged field by field (``skin-doctor``).

What is seen is :class:`skinware_drivers.doctor.evidence.Evidence`, of a running skin or of a recording. The modules
``interfaces``, ``permissions``, ``buses``, ``patches``, ``timing``, ``taxels``, ``files`` and ``machine`` have one
function each, ``check``, which yields what it makes of that. ``examining`` calls them all.
"""
