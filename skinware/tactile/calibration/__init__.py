"""Find the places of the taxels of a skin by touching it: arrays first, numpy only.

* :mod:`.placing` and :mod:`.finger`: places from presses at known points, or with a finger of unknown length.
* :mod:`.topology`: neighbours and flat maps, from strokes without any pose.
* :mod:`.checking`: the errors of a geometry.
* :mod:`.results`: geometry files; :mod:`.state`: presses and strokes, and their file; :mod:`.sources`: live drivers and
  poses.
"""
