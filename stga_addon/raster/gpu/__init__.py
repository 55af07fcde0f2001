"""GPU rasterizer: WGSL compute kernels for any GPU through WebGPU (Vulkan, Metal, Direct3D 12).

Formulas, constants and results are those of `cpu/`. Nothing here depends on the order in which
threads run: the same input gives the same bits on the same adapter. Importing this package needs
wgpu.
"""
