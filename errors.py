"""The exceptions of warploom: each says what was wrong, where, and what to do.

A wrong argument to a function of the API raises Python's own ValueError or TypeError; these are for what
comes from outside the code: files, models, configuration, devices.
"""

__all__ = ["ConfigError", "DeviceError", "ModelError", "SinkError", "SourceError", "WarploomError"]


class WarploomError(Exception):
    """The base of all of them."""


class ConfigError(WarploomError):
    """A configuration that cannot be used: names the file, the line, the key, and what was expected."""


class DeviceError(WarploomError):
    """A compute device that is not there or cannot be used."""


class ModelError(WarploomError):
    """A model file that is missing or does not fit its card."""


class SourceError(WarploomError):
    """A recording, scan or sensor stream that cannot be read."""


class SinkError(WarploomError):
    """A recording or other output that cannot be written."""
