"""Problems for `shadowmap-dr fit`, with photographs that Mitsuba's own integrators make, and the score of its results.

``python -m shadowmap_dr.experiments.bench.fits OUT`` writes problems as folders; see `catalogue` for the list.
"""
