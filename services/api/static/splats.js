// Draws posed Gaussians with WebGL2: the same projection, low-pass and cutoffs as the service's renderer.
// A picture is a list of slots, {rows: [lo, hi) in shares of the height, middle, span, weight}, as everywhere in this project.
import { Poser, order } from "./posing.js";

const WIDTH = 1024; // texels in a row of the data texture
const VERTEX = `#version 300 es
precision highp float;
uniform highp sampler2D data;
uniform mat3 rotation; uniform vec3 centre; uniform float focal; uniform vec2 size;
in vec2 corner; in uint index;
out vec2 place; flat out vec4 colour;
uniform float tint;
vec4 texel(int k) { int i = int(index) * 4 + k; return texelFetch(data, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0); }
vec3 plasma(float t) {
  const vec3 a = vec3(.05, .03, .53), b = vec3(.62, .09, .60), c = vec3(.93, .47, .33), d = vec3(.94, .97, .13);
  return t < .4 ? mix(a, b, t / .4) : t < .75 ? mix(b, c, (t - .4) / .35) : mix(c, d, (t - .75) / .25);
}
void main() {
  vec4 p = texel(0), q = texel(1), r = texel(2), s = texel(3);
  vec3 local = rotation * (p.xyz - centre);
  gl_Position = vec4(2., 2., 2., 1.);
  if (local.z < .05) return;
  mat3 cov = mat3(q.x, q.y, q.z, q.y, q.w, r.x, q.z, r.x, r.y);
  float f = focal / local.z;
  mat3 J = mat3(f, 0, 0, 0, f, 0, -f * local.x / local.z, -f * local.y / local.z, 0);
  mat3 T = J * rotation;
  mat3 S = T * cov * transpose(T);
  float a = S[0][0] + .3, b = S[1][0], c = S[1][1] + .3;
  float mid = (a + c) / 2., off = sqrt(max((a - c) * (a - c) / 4. + b * b, 0.));
  float major = mid + off, minor = max(mid - off, .05), reach = sqrt(2. * log(max(p.w * 255., 1.)));
  vec2 axis = off < 1e-9 ? vec2(1, 0) : normalize(abs(b) > 1e-9 ? vec2(b, major - a) : (a >= c ? vec2(1, 0) : vec2(0, 1)));
  place = corner * reach;
  vec2 pixel = size / 2. + focal * local.xy / local.z + place.x * sqrt(major) * axis + place.y * sqrt(minor) * vec2(-axis.y, axis.x);
  colour = vec4(mix(s.rgb, plasma(r.z) * (.35 + .65 * dot(s.rgb, vec3(.3, .6, .1))), tint), p.w);
  gl_Position = vec4(pixel.x / size.x * 2. - 1., 1. - pixel.y / size.y * 2., 0., 1.);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 place; flat in vec4 colour; out vec4 pixel;
void main() {
  float alpha = min(.99, colour.a * exp(-.5 * dot(place, place)));
  if (alpha < 1. / 255.) discard;
  pixel = vec4(colour.rgb * alpha, alpha);
}`;
const SPREAD = `#version 300 es
in vec2 corner; out vec2 place;
void main() { place = corner * .5 + .5; gl_Position = vec4(corner, 0., 1.); }`;
const WEIGH = `#version 300 es
precision highp float;
uniform sampler2D image; uniform float weight; in vec2 place; out vec4 pixel;
void main() { pixel = weight * texture(image, place); }`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.bindAttribLocation(made, 0, "corner");
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

export class SplatView {
  constructor(canvas, scene) {
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: true, antialias: false, premultipliedAlpha: true, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("WebGL 2: expected a browser that has it, got none");
    this.canvas = canvas;
    this.scene = scene;
    this.poser = new Poser(scene);
    this.sorted = new Uint32Array(scene.count);
    this.splats = program(gl, VERTEX, FRAGMENT);
    this.weigh = program(gl, SPREAD, WEIGH);
    this.half = gl.getExtension("EXT_color_buffer_float") ? gl.RGBA16F : gl.RGBA8;
    this.rows = Math.ceil((4 * scene.count) / WIDTH);
    this.data = new Float32Array(4 * WIDTH * this.rows);
    this.texture = this.newTexture();
    this.buffers();
  }

  newTexture() {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
    for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
    return made;
  }

  buffers() {
    const gl = this.gl;
    this.shape = gl.createVertexArray();
    gl.bindVertexArray(this.shape);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.indices = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    const place = gl.getAttribLocation(this.splats, "index");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.index = place;
  }

  targets() { // a picture and a sum of pictures, made when they are first needed and when the size changes
    const gl = this.gl, { width, height } = this.canvas;
    if (this.layers?.width === width && this.layers?.height === height) return this.layers;
    const make = (format) => {
      const texture = this.newTexture(), frame = gl.createFramebuffer();
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      return { texture, frame };
    };
    for (const old of this.layers ? [this.layers.one, this.layers.sum] : []) {
      gl.deleteTexture(old.texture);
      gl.deleteFramebuffer(old.frame);
    }
    this.layers = { width, height, one: make(gl.RGBA8), sum: make(this.half) };
    return this.layers;
  }

  draw(camera, slots, tint = 0) {
    const gl = this.gl, summed = slots.some((slot) => slot.weight !== 1), layers = summed ? this.targets() : null;
    this.clear(null);
    if (summed) this.clear(layers.sum.frame);
    for (const slot of slots) {
      this.prepare(camera, slot);
      if (summed) this.clear(layers.one.frame);
      gl.bindFramebuffer(gl.FRAMEBUFFER, summed ? layers.one.frame : null);
      this.drawSplats(camera, slot, tint);
      if (summed) this.add(layers.one.texture, layers.sum.frame, slot.weight);
    }
    if (summed) this.add(layers.sum.texture, null, 1);
  }

  clear(frame) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  prepare(camera, slot) {
    const gl = this.gl;
    this.poser.pose(camera, slot.middle, slot.span);
    this.data.set(this.poser.texels);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDTH, this.rows, 0, gl.RGBA, gl.FLOAT, this.data);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order(this.poser.depth, this.sorted), gl.STREAM_DRAW);
  }

  drawSplats(camera, slot, tint) {
    const gl = this.gl, { width, height } = this.canvas, at = (name) => gl.getUniformLocation(this.splats, name);
    gl.useProgram(this.splats);
    gl.uniformMatrix3fv(at("rotation"), true, camera.rotation);
    gl.uniform3fv(at("centre"), camera.centre);
    gl.uniform1f(at("focal"), camera.focal * height);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("tint"), tint);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindVertexArray(this.shape);
    gl.enableVertexAttribArray(this.index);
    const [lo, hi] = slot.rows.map((row) => Math.round(row * height));
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, height - hi, width, hi - lo);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.scene.count);
    gl.disable(gl.SCISSOR_TEST);
  }

  add(texture, frame, weight) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.useProgram(this.weigh);
    gl.uniform1f(gl.getUniformLocation(this.weigh, "weight"), weight);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.bindVertexArray(this.shape);
    gl.disableVertexAttribArray(this.index);
    gl.vertexAttribI4ui(this.index, 0, 0, 0, 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}

// The camera that frames the whole motion, carried around it; angles in degrees. As rsavatar.export.views.
export function orbitCamera(scene, azimuth, elevation, zoom) {
  const { up, front, centre, distance, focal } = scene, radians = Math.PI / 180;
  const side = cross(up, front), a = azimuth * radians, e = elevation * radians;
  const level = front.map((f, k) => Math.cos(a) * f + Math.sin(a) * side[k]);
  const away = level.map((l, k) => Math.cos(e) * l + Math.sin(e) * up[k]);
  const forward = away.map((v) => -v), right = cross(forward, up), n = Math.hypot(...right);
  const unit = right.map((v) => v / n), down = cross(forward, unit);
  return { rotation: new Float32Array([...unit, ...down, ...forward]), centre: centre.map((v, k) => v + distance * away[k]), focal: focal * zoom };
}

function cross(p, q) { return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]; }

// Slots of a shutter word, as rsavatar.shutter.rolling; `readout` in output frames.
export function slotsOf(word, time, readout) {
  const [name, text] = word.split(":"), count = Number(text) || 8;
  const whole = [0, 1], at = (i) => time + readout * ((i + 0.5) / count - 0.5);
  const still = (rows, middle, weight) => ({ rows, middle, span: [middle, middle], weight });
  if (name === "rolling" && readout > 0) return [{ rows: whole, middle: time, span: [time - readout / 2, time + readout / 2], weight: 1 }];
  if (name === "blur") return Array.from({ length: count }, (_, i) => still(whole, at(i), 1 / count));
  if (name === "bands") return Array.from({ length: count }, (_, i) => still([i / count, (i + 1) / count], at(i), 1));
  return [still(whole, time, 1)];
}
