// Decodes the scene of an exported file. viewer/compressed.py has the format, and `decompress` there does the same.

/// {geometry, harmonics} of the bytes of `columns`, as the server has them; `meta` says how they were rounded.
export function decompress(meta, buffer) {
  const { count, sh_degree: degree, compressed: made } = meta;
  const next = columnsOf(new Uint8Array(buffer), count, made.widths);
  const scales = [next(), next(), next()], differences = [next(), next(), next()], opacities = next();
  const turns = [next(), next(), next()];
  const geometry = new Float32Array(12 * count), perOpacity = new Float64Array(count);
  const mean = [0, 0, 0], steps = [0, 0, 0];
  for (let i = 0; i < count; ++i) {
    for (let k = 0; k < 3; ++k) steps[k] = scales[k][i] + made.median;
    const opacity = opacities[i] + 128, step = stepsOf(made, steps);
    let squares = 0;
    for (let k = 0; k < 3; ++k) {
      mean[k] = (Math.floor(mean[k] / step.mean + 0.5) + differences[k][i]) * step.mean;
      geometry[12 * i + k] = mean[k];
      geometry[12 * i + 4 + k] = 2 ** (steps[k] / made.octave);
      const turn = turns[k][i] * step.rotation;
      geometry[12 * i + 9 + k] = turn;
      squares += turn * turn;
    }
    geometry[12 * i + 8] = Math.sqrt(Math.max(1 - squares, 0));
    geometry[12 * i + 3] = opacity / made.opaque;
    perOpacity[i] = made.opaque / Math.max(opacity, made.faint) / made.harmonics;
  }
  return { geometry, harmonics: harmonicsOf(next, count, (degree + 1) ** 2, made.mixtures, perOpacity) };
}

/// Steps of the mean and of the rotation of a Gaussian with these scales.
function stepsOf(made, scales) {
  const [x, y, z] = scales, [fewest, most] = made.rotation;
  const small = Math.min(x, y, z), large = Math.max(x, y, z), middle = x + y + z - small - large;
  return {
    mean: 2 ** Math.max(Math.floor(middle / made.octave) - made.mean, made.finest),
    rotation: 2 ** -Math.min(fewest + Math.floor((large - small) / made.octave), most),
  };
}

/// Half floats: the coefficients of `used` harmonics as (r, g, b), filled up with zeros to a multiple of four.
function harmonicsOf(next, count, used, [grey, red, green], steps) {
  const width = 4 * Math.ceil(3 * used / 4), made = new Uint16Array(width * count);
  for (let k = 0; k < used; ++k) {
    const first = next(), second = next(), third = next();
    for (let i = 0; i < count; ++i) {
      const a = first[i] * steps[i], b = second[i] * steps[i], c = third[i] * steps[i];
      for (let j = 0; j < 3; ++j) made[width * i + 3 * k + j] = halfBits(a * grey[j] + b * red[j] + c * green[j]);
    }
  }
  return made;
}

/// A function that returns the whole numbers of the next column.
function columnsOf(bytes, count, widths) {
  let at = 0, column = 0;
  return () => {
    const made = new Float64Array(count);
    for (let byte = 0, unit = 1; byte < widths[column]; ++byte, unit *= 256, at += count) {
      for (let i = 0; i < count; ++i) made[i] += bytes[at + i] * unit;
    }
    ++column;
    for (let i = 0; i < count; ++i) made[i] = made[i] % 2 ? -(made[i] + 1) / 2 : made[i] / 2;
    return made;
  };
}

const float = new Float32Array(1), floatBits = new Uint32Array(float.buffer);

/// Bits of the nearest half float; beyond the largest it is that one.
function halfBits(number) {
  const sign = number < 0 ? 0x8000 : 0;
  float[0] = Math.min(Math.abs(number), 65504);
  if (float[0] < 2 ** -14) {  // subnormal: the sum has steps of 2^-24
    float[0] += 0.5;
    return sign | floatBits[0] - 0x3f000000;
  }
  const bits = floatBits[0];
  return sign | bits - 0x38000000 + 0xfff + (bits >>> 13 & 1) >>> 13;
}
