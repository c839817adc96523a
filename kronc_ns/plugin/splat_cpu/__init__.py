"""3D Gaussian Splatting without CUDA: a rasteriser for the CPU behind gsplat's call, and splatfacto on top of it."""
