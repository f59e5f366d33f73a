"""Where the taxels of a skin are, found by touching it: arrays first, numpy only.

* :mod:`.placing` and :mod:`.finger`: places from presses at known points, or with a finger whose tip is not known.
* :mod:`.topology` and :mod:`.unrolling`: who lies beside whom, and flat maps, from strokes without any pose.
* :mod:`.checking`: what is wrong with a geometry.
* :mod:`.sessions`, :mod:`.state`: what was gathered, and its file; :mod:`.sources`: drivers and poses, live.
"""
