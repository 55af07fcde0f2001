// Common to all kernels, after the constants and the struct View of layout.py.

// A thread in a dispatch whose workgroups fill rows of up to 65,535 (see Device.groups).
struct Thread {
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
}

fn workgroup_number(thread: Thread) -> u32 {
  return thread.workgroup.y * thread.workgroups.x + thread.workgroup.x;
}

fn thread_number(thread: Thread) -> u32 {
  return workgroup_number(thread) * WORKGROUP + thread.local;
}

// Words per row of the tables of splats and of their gradients.
fn splat_stride(view: View) -> u32 {
  return SH + 3u * view.coefficients + 3u * view.strain_colors;
}

// Words per row of the table of triangle frames.
fn frame_stride(view: View) -> u32 {
  return FRAME_STRAIN + view.frame_strains;
}
