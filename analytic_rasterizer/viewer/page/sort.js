// A worker that orders Gaussians by depth. Messages: {geometry, count}; then {row, near}, the row of the world-to-camera
// matrix for the depth. Answer: {order}, indices of what is beyond `near`, the farthest first, of equals the last.
'use strict';

const STRIDE = 12;  // numbers of a Gaussian in geometry

let geometry, count, keys, keysB, indices, indicesB;

onmessage = ({ data }) => {
  if (data.geometry) {
    ({ geometry, count } = data);
    [keys, keysB, indices, indicesB] = Array.from({ length: 4 }, () => new Uint32Array(count));
    return;
  }
  const visible = depths(data.row, data.near);
  const order = sorted(visible).slice(0, visible).reverse();
  postMessage({ order }, [order.buffer]);
};

/// Writes the keys and indices of the Gaussians beyond `near`, and returns how many. Sums are rounded at every step, as
/// the rasterizer rounds them. Positive floats are ordered as their bits are.
function depths(row, near) {
  const fround = Math.fround, values = new Float32Array(keys.buffer);
  const [x, y, z, w] = row, limit = fround(near);
  let visible = 0;
  for (let i = 0, at = 0; i < count; ++i, at += STRIDE) {
    const xy = fround(fround(x * geometry[at]) + fround(y * geometry[at + 1]));
    const depth = fround(fround(xy + fround(z * geometry[at + 2])) + w);
    if (depth > limit) {
      values[visible] = depth;
      indices[visible++] = i;
    }
  }
  return visible;
}

/// Two stable counting passes over 16 bits each.
function sorted(visible) {
  let from = keys, to = keysB, a = indices, b = indicesB;
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < visible; ++i) ++starts[((from[i] >>> shift) & 65535) + 1];
    for (let k = 0; k < 65536; ++k) starts[k + 1] += starts[k];
    for (let i = 0; i < visible; ++i) {
      const place = starts[(from[i] >>> shift) & 65535]++;
      b[place] = a[i];
      to[place] = from[i];
    }
    [from, to, a, b] = [to, from, b, a];
  }
  return a;
}
