import numpy as np
import pytest

from warploom.components.messages import SensorFrame
from warploom.components.sources import Source


class Endless(Source):
    """A source that does not know how long it is."""

    length = None

    def __iter__(self):
        for index in range(3):
            yield SensorFrame(version=index, index=index, points=np.zeros((1, 4), np.float32))


def test_a_source_of_unknown_length_says_so():
    source = Endless("endless")
    with pytest.raises(TypeError, match="endless: the number of frames is not known"):
        len(source)
    assert repr(source) == "Endless('endless', unknown length)"
    assert [frame.index for frame in source] == [0, 1, 2]
    assert next(source).index == 0
    assert source.skipped == []
