// Vectors are arrays of 3, quaternions wxyz, matrices 4x4 in columns, as WebGL has them.

export const identity = () => Float32Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);

export const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
export const subtract = (a, b) => add(a, b, -1);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(...a);
export const unit = (a) => a.map((value) => value / (length(a) || 1));
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 16; column += 4) {
    for (let row = 0; row < 4; row += 1) {
      product[column + row] = a[row] * b[column] + a[4 + row] * b[column + 1] + a[8 + row] * b[column + 2]
        + a[12 + row] * b[column + 3];
    }
  }
  return product;
}

export function placed([x, y, z], [w, i, j, k]) {
  return Float32Array.from([
    1 - 2 * (j * j + k * k), 2 * (i * j + k * w), 2 * (i * k - j * w), 0,
    2 * (i * j - k * w), 1 - 2 * (i * i + k * k), 2 * (j * k + i * w), 0,
    2 * (i * k + j * w), 2 * (j * k - i * w), 1 - 2 * (i * i + j * j), 0,
    x, y, z, 1,
  ]);
}

// A turn about an axis through a point.
export function turned(axis, angle, point) {
  const half = Math.sin(angle / 2);
  const turn = placed([0, 0, 0], [Math.cos(angle / 2), ...axis.map((value) => value * half)]);
  const moved = subtract(point, transform(turn, point));
  turn.set(moved, 12);
  return turn;
}

export const shifted = (by) => placed(by, [1, 0, 0, 0]);

export function transform(matrix, [x, y, z]) {
  return [0, 1, 2].map((row) => matrix[row] * x + matrix[4 + row] * y + matrix[8 + row] * z + matrix[12 + row]);
}

export function perspective(degrees, aspect, near, far) {
  const f = 1 / Math.tan(degrees * Math.PI / 360);
  return Float32Array.from([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
}

// The view from a point to another, with z up: matrix, and the directions right, up and ahead.
export function looking(from, to) {
  const ahead = unit(subtract(to, from));
  const right = unit(cross(ahead, [0, 0, 1]));
  const up = cross(right, ahead);
  const matrix = Float32Array.from([
    right[0], up[0], -ahead[0], 0, right[1], up[1], -ahead[1], 0, right[2], up[2], -ahead[2], 0,
    -dot(right, from), -dot(up, from), dot(ahead, from), 1,
  ]);
  return { matrix, right, up, ahead };
}

// Target and distance of the camera from which all points are visible; unchanged if they already are.
// `half`: half the visible height at distance 1.
export function framed(points, target, distance, half) {
  const reach = (from) => 1.2 * Math.max(...points.map((point) => length(subtract(point, from))));
  if (!points.length || reach(target) <= distance * half) return { target, distance };
  const centre = [0, 1, 2].map((i) => {
    const values = points.map((point) => point[i]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  return { target: centre, distance: Math.max(distance, reach(centre) / half) };
}
