// The uniform `pose` of a mesh, see frames.py.

struct Pose {
  // The matrix from the mesh, relative to its first vertex, to the camera.
  row_x: vec4f,
  row_y: vec4f,
  row_z: vec4f,
  triangles: u32,
  strains: u32, // components of strain, 0 where neither colors nor positions follow it
  area_scales: u32, // 1: the convention "stga", 0: "gaussian_avatars"
  padding: u32,
}
