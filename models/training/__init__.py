"""The recipe of the shipped detection head: simulated scenes, a pillar centre network, its training and its export.

`python -m warploom.models.training --out DIR` trains one, `loop.train` does so from Python, `export.export_head`
writes the two files of a head. Needs torch (`pip install warploom[torch]`); nothing is imported here, so that the
processes that simulate do without it.
"""
