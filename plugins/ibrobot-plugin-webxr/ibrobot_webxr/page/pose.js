// Quaternions (x, y, z, w), in WebXR's frame: x to the right, y up, z towards the viewer.

export function multiply([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
    aw * bw - ax * bx - ay * by - az * bz,
  ];
}

export function rotate(q, [x, y, z]) {
  const [rx, ry, rz] = multiply(multiply(q, [x, y, z, 0]), [-q[0], -q[1], -q[2], q[3]]);
  return [rx, ry, rz];
}

// Where a viewer with this orientation looks, as an angle about the y axis: 0 is -z, positive to the left.
export function headingOf(orientation) {
  let [x, y, z] = rotate(orientation, [0, 0, -1]);
  if (Math.abs(y) > 0.7) {
    // Looking down, the upper edge points forward; looking up, it points back.
    const up = rotate(orientation, [0, 1, 0]);
    const sign = y < 0 ? 1 : -1;
    [x, z] = [sign * up[0], sign * up[2]];
  }
  return Math.atan2(-x, -z);
}

// The orientation of a phone from the angles [degrees] of a `deviceorientation` event (W3C: rotations about z, x', y'').
export function fromDeviceOrientation(alpha, beta, gamma) {
  const half = Math.PI / 360;
  const about = (axis, angle) => {
    const q = [0, 0, 0, Math.cos(angle * half)];
    q[axis] = Math.sin(angle * half);
    return q;
  };
  const inEarth = multiply(multiply(about(2, alpha), about(0, beta)), about(1, gamma)); // x east, y north, z up
  return multiply(about(0, -90), inEarth);
}

const STRAIGHT = 1.4, CURLED = 1.2;

// Bending the middle finger holds the clutch, with hysteresis: ratio of the distances of tip and knuckle from the wrist.
export function curledClutch(held, wrist, knuckle, tip) {
  const ratio = distance(tip, wrist) / Math.max(distance(knuckle, wrist), 1e-3);
  return ratio < (held ? STRAIGHT : CURLED);
}

const PINCHED_M = 0.02, SPREAD_M = 0.08;

// Thumb and index finger as a trigger: 0 spread, 1 together.
export function pinch(thumb, index) {
  return Math.max(0, Math.min(1, (SPREAD_M - distance(thumb, index)) / (SPREAD_M - PINCHED_M)));
}

function distance(a, b) {
  return Math.hypot(a.x - b.x, a.y - b.y, a.z - b.z);
}
