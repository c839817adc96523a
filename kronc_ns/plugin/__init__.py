"""The nerfstudio side: the only part of the package that imports nerfstudio."""
