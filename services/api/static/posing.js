// An avatar's scene, and the pose of every Gaussian at any instant: linear blend skinning as the service's kernels do it.
// Times are in output frames; the layout of the file is that of rsavatar.export.scene.
const TYPES = { f4: Float32Array, u1: Uint8Array };
const CLOCK = 129; // instants over a readout at which joint transforms are tabulated for rolling shutters
const ROUNDS = 3; // fixed-point rounds for the instant at which a row meets a Gaussian
const C0 = 0.28209479177387814, C1 = 0.4886025119029199;

export function parseScene(buffer) {
  const view = new DataView(buffer);
  if (new TextDecoder().decode(buffer.slice(0, 4)) !== "RSAV") throw new Error("scene: expected RSAV, got other bytes");
  const length = view.getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const start = Math.ceil((8 + length) / 4) * 4;
  const arrays = {};
  for (const [name, { dtype, shape, offset }] of Object.entries(header.arrays)) {
    arrays[name] = new TYPES[dtype](buffer, start + offset, shape.reduce((a, b) => a * b, 1));
  }
  const [frames, instants, joints] = header.arrays.maps.shape;
  return { ...header, ...arrays, count: header.arrays.means.shape[0], bases: header.arrays.sh.shape[1], instants, block: joints * 12, frames };
}

export class Poser {
  constructor(scene) {
    this.scene = scene;
    const n = scene.count;
    this.texels = new Float32Array(16 * n); // mean, opacity; six of the covariance; colour, share of the readout
    this.depth = new Float32Array(n);
    this.share = new Float32Array(n).fill(0.5);
    this.table = new Float32Array(CLOCK * scene.block);
  }

  frameOf(time) { return Math.min(Math.max(Math.round(time), 0), this.scene.frames - 1); }

  joints(time, out, at) { // joint transforms at an instant, linear between the tabulated ones
    const { maps, block, instants } = this.scene, frame = this.frameOf(time);
    const place = Math.min(Math.max((time - frame + 0.5) * (instants - 1), 0), instants - 1.0001);
    const low = Math.floor(place), f = place - low, base = (frame * instants + low) * block;
    for (let k = 0; k < block; k++) out[at + k] = maps[base + k] * (1 - f) + maps[base + block + k] * f;
  }

  // camera: {rotation (9, rows right, down, forward), centre, focal, height}; span: [first, last] instant of the rows;
  // a span of one instant poses all at once, else every Gaussian at the instant of the row that it falls on.
  pose(camera, middle, span) {
    const rolling = span[1] !== span[0], steps = rolling ? CLOCK : 1;
    for (let i = 0; i < steps; i++) {
      this.joints(steps > 1 ? span[0] + ((span[1] - span[0]) * i) / (steps - 1) : middle, this.table, i * this.scene.block);
    }
    for (let i = 0; i < this.scene.count; i++) this.one(i, camera, rolling, middle);
  }

  one(i, camera, rolling, middle) {
    const s = this.scene, A = this.affine ??= new Float64Array(12);
    const offset = s.offsets ? (this.frameOf(middle) * s.count + i) * 3 : -1;
    const x = s.means[3 * i] + (offset < 0 ? 0 : s.offsets[offset]);
    const y = s.means[3 * i + 1] + (offset < 0 ? 0 : s.offsets[offset + 1]);
    const z = s.means[3 * i + 2] + (offset < 0 ? 0 : s.offsets[offset + 2]);
    const R = camera.rotation, c = camera.centre;
    let share = rolling ? this.share[i] : 0.5, X, Y, Z, depth;
    for (let round = 0; round < (rolling ? ROUNDS : 1); round++) {
      this.blend(i, rolling ? Math.round(share * (CLOCK - 1)) : 0, A);
      X = A[0] * x + A[1] * y + A[2] * z + A[3];
      Y = A[4] * x + A[5] * y + A[6] * z + A[7];
      Z = A[8] * x + A[9] * y + A[10] * z + A[11];
      const dx = X - c[0], dy = Y - c[1], dz = Z - c[2];
      depth = R[6] * dx + R[7] * dy + R[8] * dz;
      const row = 0.5 + (camera.focal * (R[3] * dx + R[4] * dy + R[5] * dz)) / depth;
      if (rolling) share = Math.min(Math.max(row, 0), 1);
    }
    this.share[i] = share;
    this.depth[i] = depth;
    this.write(i, A, X, Y, Z, c);
  }

  blend(i, instant, A) {
    const { joints, weights, block } = this.scene, table = this.table, base = instant * block;
    A.fill(0);
    for (let k = 4 * i; k < 4 * i + 4; k++) {
      const w = weights[k], at = base + 12 * joints[k];
      if (w === 0) continue;
      for (let e = 0; e < 12; e++) A[e] += w * table[at + e];
    }
  }

  write(i, A, X, Y, Z, centre) {
    const s = this.scene, t = this.texels, o = 16 * i, m = s.axes, a = 9 * i, F = this.axes ??= new Float64Array(9);
    for (let r = 0; r < 3; r++) for (let k = 0; k < 3; k++) {
      F[3 * r + k] = A[4 * r] * m[a + k] + A[4 * r + 1] * m[a + 3 + k] + A[4 * r + 2] * m[a + 6 + k];
    }
    const dot = (p, q) => F[p] * F[q] + F[p + 1] * F[q + 1] + F[p + 2] * F[q + 2];
    t[o] = X; t[o + 1] = Y; t[o + 2] = Z; t[o + 3] = s.opacity[i];
    t[o + 4] = dot(0, 0); t[o + 5] = dot(0, 3); t[o + 6] = dot(0, 6);
    t[o + 7] = dot(3, 3); t[o + 8] = dot(3, 6); t[o + 9] = dot(6, 6);
    t[o + 10] = this.share[i]; t[o + 11] = 0;
    const dx = X - centre[0], dy = Y - centre[1], dz = Z - centre[2], n = 1 / Math.hypot(dx, dy, dz), b = s.bases;
    for (let k = 0; k < 3; k++) {
      let colour = 0.5 + C0 * s.sh[3 * b * i + k];
      if (b > 1) colour += C1 * n * (-dy * s.sh[3 * b * i + 3 + k] + dz * s.sh[3 * b * i + 6 + k] - dx * s.sh[3 * b * i + 9 + k]);
      t[o + 12 + k] = Math.max(colour, 0);
    }
  }
}

// Indices from the farthest to the nearest: a counting sort of depths in 65536 steps.
export function order(depth, out) {
  let low = Infinity, high = -Infinity;
  for (const d of depth) { if (d < low) low = d; if (d > high) high = d; }
  const steps = 65536, scale = (steps - 1) / (high - low || 1), counts = new Uint32Array(steps + 1);
  const keys = Uint16Array.from(depth, (d) => (high - d) * scale);
  for (const k of keys) counts[k + 1]++;
  for (let k = 0; k < steps; k++) counts[k + 1] += counts[k];
  for (let i = 0; i < keys.length; i++) out[counts[keys[i]]++] = i;
  return out;
}
