// Spherical harmonics, csrc/core/sh.h, as text of a shader. (x, y, z) is the direction; xx, yy, zz are squares.

const BASIS = [
  '0.28209479177387814',
  '-0.4886025119029199 * y', '0.4886025119029199 * z', '-0.4886025119029199 * x',
  '1.0925484305920792 * x * y', '-1.0925484305920792 * y * z', '0.31539156525252005 * (2.0 * zz - xx - yy)',
  '-1.0925484305920792 * x * z', '0.5462742152960396 * (xx - yy)',
  '-0.5900435899266435 * y * (3.0 * xx - yy)', '2.890611442640554 * x * y * z',
  '-0.4570457994644658 * y * (4.0 * zz - xx - yy)', '0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)',
  '-0.4570457994644658 * x * (4.0 * zz - xx - yy)', '1.445305721320277 * z * (xx - yy)',
  '-0.5900435899266435 * x * (xx - 3.0 * yy)',
];

/// GLSL that returns the colour seen in a `direction`, of harmonics up to a degree. `number(k)` is text for number k.
export const harmonicsColor = (degree, number) => `
  float x = direction.x; float y = direction.y; float z = direction.z;
  float xx = x * x; float yy = y * y; float zz = z * z;
  vec3 color;
  color = vec3(0.5);
  ${BASIS.slice(0, (degree + 1) ** 2).map((basis, k) =>
    `color += (${basis}) * vec3(${number(3 * k)}, ${number(3 * k + 1)}, ${number(3 * k + 2)});`).join('\n  ')}
  return max(color, vec3(0.0));`;

/// Numbers that the harmonics of a Gaussian take: a multiple of four.
export const harmonicNumbers = degree => 4 * Math.ceil((3 * (degree + 1) ** 2) / 4);

/// Bytes of geometry and of harmonics of a Gaussian. `compact` is how small scenes are (viewer/compact.py).
export const sceneBytes = ({ sh_degree: degree, compact }) => (compact
  ? [24, 8 + 4 * Math.ceil((3 * ((degree + 1) ** 2 - 1)) / 4)] : [48, 2 * harmonicNumbers(degree)]);

/// An Error where a device has no room for a scene. `working` is what it takes beside, of each Gaussian [bytes].
export function noRoom(meta, working) {
  const [geometry, harmonics] = sceneBytes(meta), bytes = meta.count * (geometry + harmonics + working);
  return new Error(
    `The graphics device has no room for the scene, which takes ${Math.ceil(bytes / 1e6)} MB of its memory.`);
}
