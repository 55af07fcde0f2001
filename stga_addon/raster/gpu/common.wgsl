// Common to all kernels, after the constants and the struct View of layout.py.

// Number of this thread in a dispatch whose workgroups fill rows of up to 65,535 (see Device.groups).
fn thread_number(workgroup: vec3u, workgroups: vec3u, local: u32) -> u32 {
  return (workgroup.y * workgroups.x + workgroup.x) * WORKGROUP + local;
}

// Words per row of the tables of splats and of their gradients.
fn splat_stride(view: View) -> u32 {
  return SH + 3u * view.coefficients + 3u * view.strain_colors;
}

// Words per row of the table of triangle frames.
fn frame_stride(view: View) -> u32 {
  return FRAME_STRAIN + view.frame_strains;
}
