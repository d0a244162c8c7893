"""Messages of other projects' policy servers: msgpack with arrays, checked and never unpickled."""

from ibrobot_policy_wire.arrays import MAX_MESSAGE, pack, pack_named, pack_npy, unpack, unpack_named, unpack_npy

__all__ = ["MAX_MESSAGE", "pack", "pack_named", "pack_npy", "unpack", "unpack_named", "unpack_npy"]
