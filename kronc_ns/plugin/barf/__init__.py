"""BARF (Lin et al., ICCV 2021) and L2G-NeRF (Chen et al., CVPR 2023) as nerfstudio methods, written from the papers."""
