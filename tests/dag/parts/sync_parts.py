"""A mesh on a manual clock."""

from warploom.datamesh import CommitPolicy, DataMesh, Input, ManualClock, Output


class Mesh:
    """A mesh on a manual clock, with both ends of its topics."""

    def __init__(self, *topics, capacity=8, clock=None):
        self.clock = ManualClock() if clock is None else clock
        self.mesh = DataMesh(capacity, clock=self.clock)
        self.inputs, self.outputs = {}, {}
        for topic in topics:
            self.inputs[topic], self.outputs[topic] = Input(), Output()
            self.inputs[topic].bind(topic, self.mesh.window(topic))
            self.outputs[topic].bind(topic, self.mesh.window(topic))

    def commit(self, topic, *versions, epoch=None, completion=None):
        for version in versions:
            with self.outputs[topic].allocate_change() as change:
                change.set_version(version, epoch=epoch)
                change.value = f"{topic} {version}"
                if completion is not None:
                    change.completes_with(completion)
                self.outputs[topic].commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
