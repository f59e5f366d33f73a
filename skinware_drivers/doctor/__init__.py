"""Find out what is wrong with a skin and with the machine that reads it (``skin-doctor``).

:mod:`looking` and :mod:`recorded` gather :class:`evidence.Evidence` of a running skin and of a recording. The modules
``buses``, ``patches``, ``programs`` and ``machine`` check it; ``rules.toml`` has the texts of all findings,
and what to do. :mod:`examining` runs all checks.
"""
