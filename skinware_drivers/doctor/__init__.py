"""Find out what is wrong with a skin and with the machine that reads it (``skin-doctor``).

:mod:`looking` and :mod:`recorded` gather :class:`evidence.Evidence` of a running skin and of a recording. The modules
``buses``, ``patches``, ``programs``, ``taxels``, ``files`` and ``machine`` hold the rules, as tables of texts and
advice, and the checks that apply them. :mod:`examining` runs all checks.
"""
