"""Direct Voxel Grid Optimization (Sun, Sun and Chen, CVPR 2022) as a nerfstudio method, written from the paper."""
