"""Goals: how users write them, and the joint positions that reach them."""
