"""Messages as bytes: a lossless codec, and the types that are known to it; those of ROS in modules by its packages."""

from . import geometry, nav, sensor, std
from .codec import Decoder, MessageType, decode, encode, message, message_type

__all__ = ["Decoder", "MessageType", "decode", "encode", "geometry", "message", "message_type", "nav", "sensor", "std"]
