"""Heads from well-known checkpoints that the user brings: each importer writes an ONNX file and a card.

Checkpoints are read with `torch.load(weights_only=True)` and `np.load(allow_pickle=False)` alone: nothing in them
is run. Needs torch (`pip install warploom[torch]`); to run what was imported does not.
"""
