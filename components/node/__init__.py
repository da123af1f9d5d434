"""The components of a node beside perception: drivers, preprocessing, scheduling, reports, watches, outputs.

`idle_because` of a component says why it has nothing to do, None where it has; `state()` is what `warploom ps` shows.
"""
