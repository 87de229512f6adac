// The camera: a pose, the point that it turns about, and a lens. Axes are OpenCV's: x right, y down, z forward.
// Vectors are arrays of three numbers, quaternions are (w, x, y, z).

import { CONSTANTS } from './constants.js';

export const add = (a, b) => a.map((value, i) => value + b[i]);
export const times = (a, factor) => a.map(value => value * factor);
export const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const unit = a => times(a, 1 / Math.hypot(...a));
const minus = (a, b) => a.map((value, i) => value - b[i]);

// Distances of the point that the camera turns about; the farthest in radii of the scene.
const NEAREST = 1.5 * CONSTANTS.kNear, FARTHEST = 30;
// The angle between looking direction and up stays this far from 0 and pi when turning about a point.
const STEEPEST = 0.05;

/// Turns v about a unit axis by an angle.
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(times(v, c), times(cross(axis, v), s)), times(axis, dot(axis, v) * (1 - c)));
}

/// The quaternion of a rotation matrix, given by its rows.
function quaternionOf([x, y, z]) {
  // Its multiples by four times each of its numbers, of which the longest is the most exact.
  const multiples = [
    [1 + x[0] + y[1] + z[2], z[1] - y[2], x[2] - z[0], y[0] - x[1]],
    [z[1] - y[2], 1 + x[0] - y[1] - z[2], x[1] + y[0], x[2] + z[0]],
    [x[2] - z[0], x[1] + y[0], 1 + y[1] - x[0] - z[2], y[2] + z[1]],
    [y[0] - x[1], x[2] + z[0], y[2] + z[1], 1 + z[2] - x[0] - y[1]],
  ];
  return unit(multiples.sort((a, b) => dot(b, b) - dot(a, a))[0]);
}

/// Rows of the rotation matrix of a quaternion.
function rotationOf(quaternion) {
  const [w, x, y, z] = unit(quaternion);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/// The pose a part of the way from one to another.
export function between(from, to, part) {
  const a = quaternionOf(from.axes), b = quaternionOf(to.axes);
  const mix = (u, v) => add(times(u, 1 - part), times(v, part));
  return {
    position: mix(from.position, to.position),
    axes: rotationOf(mix(a, times(b, dot(a, b) < 0 ? -1 : 1))),  // of both quaternions of a rotation the nearer one
    distance: mix([from.distance], [to.distance])[0],
  };
}

/// Where a pinhole is, and the largest |x/z| and |y/z| that the Jacobian of its projection sees.
export function eyeAndLimits({ width, height, fx, fy, w2c: v }) {
  const clamp = CONSTANTS.kFrustumClamp / 2;
  return {
    eye: [0, 1, 2].map(c => -(v[c] * v[3] + v[4 + c] * v[7] + v[8 + c] * v[11])),
    limits: [(clamp * width) / fx, (clamp * height) / fy],
  };
}

export class Camera {
  /// `meta` is that of the scene. Starts at its first view.
  constructor(meta) {
    this.meta = meta;
    this.up = meta.up;
    this.setView(0);
  }

  /// The pose: position, axes (rows right, down, forward) and distance of the point that the camera turns about.
  get pose() { return { position: this.position, axes: this.axes, distance: this.distance }; }
  set pose(pose) { Object.assign(this, pose); }

  /// Pose of view k. The camera turns about the point in front of it that is nearest to the middle of the scene.
  poseOfView(k) {
    const m = this.meta.views[k].w2c;
    const axes = [0, 1, 2].map(r => unit(m.slice(4 * r, 4 * r + 3)));
    const { eye: position } = eyeAndLimits(this.meta.views[k]);
    const ahead = dot(minus(this.meta.center, position), axes[2]);
    return { position, axes, distance: Math.max(ahead, 0.1 * this.meta.radius) };
  }

  setView(k) {
    this.view = k;
    this.lens = this.meta.views[k];
    this.pose = this.poseOfView(k);
  }

  get target() { return add(this.position, times(this.axes[2], this.distance)); }

  /// The matrix from world to camera, 16 numbers by rows. `exactly` at view k, it is that of the file.
  matrix(exactly) {
    if (exactly) return this.meta.views[this.view].w2c;
    const rows = this.axes.map(axis => [...axis, -dot(axis, this.position)]);
    return [...rows.flat(), 0, 0, 0, 1];
  }

  /// What the renderer needs for a picture of this size. `stretch` fills it with exactly the view, as the rasterizer
  /// does; otherwise pixels are square and all of the view is in the picture.
  pinhole(width, height, stretch, exactly = false) {
    const { lens } = this, x = width / lens.width, y = height / lens.height, least = Math.min(x, y);
    const [sx, sy] = stretch ? [x, y] : [least, least];
    return {
      width, height, w2c: this.matrix(exactly), fx: lens.fx * sx, fy: lens.fy * sy,
      cx: width / 2 + (lens.cx - lens.width / 2) * sx, cy: height / 2 + (lens.cy - lens.height / 2) * sy,
    };
  }

  /// Turns about the target, by angles, so that the scene turns to the right about up, then down about the x axis.
  orbit(right, down) {
    const { target } = this, angle = Math.acos(Math.min(Math.max(dot(this.axes[2], this.up), -1), 1));
    // A view of a file may look more steeply than the limit: then turning is free until it is within.
    const free = angle < STEEPEST || angle > Math.PI - STEEPEST;
    const wanted = free ? angle + down : Math.min(Math.max(angle + down, STEEPEST), Math.PI - STEEPEST);
    const level = this.axes.map(axis => turned(axis, this.up, -right));
    const axes = level.map(axis => turned(axis, level[0], angle - wanted));
    const x = unit(axes[0]), forward = unit(minus(axes[2], times(x, dot(axes[2], x))));
    this.axes = [x, cross(forward, x), forward];
    this.position = add(target, times(forward, -this.distance));
  }

  /// Moves along the axes of the camera, right, down and forward, world units.
  move(...steps) {
    for (const [i, step] of steps.entries()) this.position = add(this.position, times(this.axes[i], step));
  }

  /// Moves right and down, by parts of the distance.
  pan(x, y) { this.move(x * this.distance, y * this.distance); }

  /// Moves towards the target so that its distance is multiplied by a factor.
  dolly(factor) {
    const { target } = this;
    // A pose from elsewhere may be beyond the limits, and stays where it is until it is moved to within.
    const { distance } = this, least = Math.min(NEAREST, distance);
    const most = Math.max(FARTHEST * this.meta.radius, NEAREST, distance);
    this.distance = Math.min(Math.max(distance * factor, least), most);
    this.position = add(target, times(this.axes[2], -this.distance));
  }

  /// Direction of a pixel of a picture, of length 1 along the optical axis.
  ray(pinhole, x, y) {
    const a = (x - pinhole.cx) / pinhole.fx, b = (y - pinhole.cy) / pinhole.fy;
    return add(add(times(this.axes[0], a), times(this.axes[1], b)), this.axes[2]);
  }

  /// The pose that looks at a point from where the camera is.
  poseTowards(point) {
    const way = minus(point, this.position), forward = unit(way);
    const side = cross(forward, this.up);
    const right = Math.hypot(...side) > 1e-3 ? unit(side) : this.axes[0];
    return { position: this.position, axes: [right, cross(forward, right), forward], distance: Math.hypot(...way) };
  }

  /// The pose as text for the address, and back; null where the text is none.
  poseText() {
    const numbers = [...this.position, ...quaternionOf(this.axes), this.distance];
    return numbers.map(value => Number(value.toPrecision(7))).join(',');
  }

  static poseFromText(text) {
    const numbers = text.split(',').map(Number), quaternion = numbers.slice(3, 7), distance = numbers[7];
    const valid = numbers.length === 8 && numbers.every(Number.isFinite) && quaternion.some(Boolean) && distance > 0;
    return valid ? { position: numbers.slice(0, 3), axes: rotationOf(quaternion), distance } : null;
  }
}

/// Depth at which half of the light of a pixel is gone, or null where it meets nothing. Splats count as round.
export function depthAt(geometry, pinhole, x, y) {
  const m = pinhole.w2c, hits = [], g = geometry;
  const row = (k, at) => m[k] * g[at] + m[k + 1] * g[at + 1] + m[k + 2] * g[at + 2] + m[k + 3];
  for (let at = 0; at < geometry.length; at += 12) {
    const z = row(8, at);
    if (!(z > CONSTANTS.kNear)) continue;
    const dx = (pinhole.fx * row(0, at)) / z + pinhole.cx - x, dy = (pinhole.fy * row(4, at)) / z + pinhole.cy - y;
    const size = Math.cbrt(g[at + 4] * g[at + 5] * g[at + 6]);
    const sigma = 1 + (pinhole.fx * size) / z, squared = (dx * dx + dy * dy) / (sigma * sigma);
    if (squared < 9) hits.push([z, g[at + 3] * Math.exp(-0.5 * squared)]);
  }
  hits.sort((a, b) => a[0] - b[0]);
  let transmittance = 1;
  for (const [z, alpha] of hits) {
    transmittance *= 1 - alpha;
    if (transmittance < 0.5) return z;
  }
  return hits[0]?.[0] ?? null;
}
