"""NeRFs from a moving event camera and its imperfect trajectory."""
