"""Messages as bytes: a lossless codec, and the types that are known to it."""

from .codec import Decoder, MessageType, decode, encode, message, message_type

__all__ = ["Decoder", "MessageType", "decode", "encode", "message", "message_type"]
