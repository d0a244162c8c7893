"""ROS 2 without ROS for ibrobot: messages to and from CDR, message definitions, type hashes."""

from ibrobot_ros2.codec import Codec, decode, encode
from ibrobot_ros2.definitions import CodecError, definition, is_idl, type_hash

__all__ = ["Codec", "CodecError", "decode", "definition", "encode", "is_idl", "type_hash"]
