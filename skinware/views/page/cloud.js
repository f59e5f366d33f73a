// The taxels of one type of a driver in WebGL: points, each drawn as a disc that lies in the skin. Those with a sign are
// drawn apart: a program without branches is much faster where no graphics card runs it.

import {
  BufferAttribute,
  BufferGeometry,
  DynamicDrawUsage,
  GLSL3,
  IntType,
  Points,
  RawShaderMaterial,
} from "./vendor/three.min.js";
import { DIMMED } from "./marks.js";

const VERTEX = `
precision highp float;
precision highp usampler2D;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform mat3 normalMatrix;
uniform float pixels;      // of 1 m at a distance of 1 m
uniform sampler2D ramp;
uniform vec3 ground;
in vec3 position;
in vec3 normal;
in float radius;
in uint level;
in uint mark;
flat out vec3 colour;
flat out vec3 slope;       // x, y: depth of the disc over the point; z: pixels of its radius
flat out uint kind;
flat out float veil;

void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  float size = max(radius * pixels / -seen.z, 1.5);
  gl_PointSize = 2.0 * size + 1.0;
  vec3 n = vec3(0.0, 0.0, 1.0);
  float facing = 1.0;
  if (dot(normal, normal) > 0.0) {
    n = normalize(normalMatrix * normal);
    facing = dot(n, normalize(-seen.xyz));
    float z = abs(n.z) < 0.2 ? (n.z < 0.0 ? -0.2 : 0.2) : n.z;
    slope.xy = size < 3.0 ? vec2(0.0) : n.xy / z;
  } else slope.xy = vec2(0.0);
  slope.z = size;
  colour = texelFetch(ramp, ivec2(int(level), 0), 0).rgb;
  kind = mark & 0x7fu;
  if ((kind != 0u) != HAS_SIGN) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // not of this program: outside the picture
  if (kind == 1u) colour = mix(colour, ground, 0.6);
  veil = (mark & 0x80u) != 0u ? 0.78 : facing < 0.0 ? 0.7 : 0.0;  // not selected; seen from inside
}`;

// Every sign is drawn in units of the disc's radius, and left out where the disc is too small to show it.
const FRAGMENT = `
precision highp float;
uniform vec3 ground, ink;
flat in vec3 colour;
flat in vec3 slope;
flat in uint kind;
flat in float veil;
out vec4 shown;

void main() {
  vec2 p = (vec2(2.0, -2.0) * gl_PointCoord + vec2(-1.0, 1.0)) * (1.0 + 0.5 / slope.z);
  float depth = dot(slope.xy, p);
  float r = sqrt(dot(p, p) + depth * depth);
  float edge = (1.0 - r) * slope.z + 0.5;                 // pixels from the rim inwards
  if (edge <= 0.0) discard;
  vec3 c = colour;
  if (HAS_SIGN) {
    float pen = clamp(1.3 / slope.z, 0.14, 0.4);
    bool rim = r > 1.0 - pen;
    vec3 soft = mix(ground, ink, 0.45);
    vec3 away = distance(c, ink) > distance(c, ground) ? ink : ground;  // the ink with the greater contrast
    if (kind == 1u) { if (rim) c = soft; else if (r > 0.62) c = ground; }
    else if (kind == 2u) { if (rim || (r > 1.0 - 3.0 * pen && r < 1.0 - 2.0 * pen)) c = away; }
    else if (kind == 3u) { if (r < 0.3) c = ink; else if (r < 0.66) c = ground; }
    else if (kind == 4u) { if (min(abs(p.x), abs(p.y)) < pen) c = away; }
    else if (kind == 5u) { c = rim || fract((p.x + p.y) * min(1.6, slope.z / 5.0)) < 0.42 ? soft : ground; }
    else if (kind == 6u) { c = rim || abs(p.y) < 0.7 * pen ? soft : ground; }
    else if (kind == 7u) { c = r < 0.42 ? ink : rim ? soft : ground; }
    else if (kind == 8u) { c = abs(abs(p.x) - abs(p.y)) < pen ? ink : ground; }
    else if (kind == 9u) { c = r > 1.0 - 1.8 * pen ? ink : mix(ground, ink, 0.12); }
    else if (rim) c = soft; else c = ground;
  }
  shown = vec4(mix(c, ground, veil), min(edge, 1.0));
}`;

/** The materials of all clouds, without signs and with them; the stage sets their uniforms, which are the same. */
export function discs(rampTexture) {
  const uniforms = {
    ramp: { value: rampTexture },
    pixels: { value: 1 },
    ground: { value: [0, 0, 0] },
    ink: { value: [1, 1, 1] },
  };
  const common = {
    glslVersion: GLSL3,
    transparent: true, // at their rims
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms,
  };
  return ["false", "true"].map((HAS_SIGN) => new RawShaderMaterial({ ...common, defines: { HAS_SIGN } }));
}

/** Points of a sheet; `update` uploads what has changed of its levels and marks. */
export class Cloud {
  constructor(sheet, materials) {
    this.sheet = sheet;
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", new BufferAttribute(sheet.position, 3));
    this.geometry.setAttribute("normal", new BufferAttribute(sheet.normal, 3));
    this.geometry.setAttribute("radius", new BufferAttribute(sheet.radius, 1));
    this.levels = bytes(sheet.n);
    this.marks = bytes(sheet.n);
    this.geometry.setAttribute("level", this.levels);
    this.geometry.setAttribute("mark", this.marks);
    this.points = materials.map((material) => new Points(this.geometry, material));
    for (const points of this.points) points.frustumCulled = false;
    this.update();
  }

  update() {
    const { levels, marks } = this.sheet.shown;
    this.levels.array.set(levels);
    this.levels.needsUpdate = true;
    if (this.marksSeen !== this.sheet.marksVersion) {
      this.marksSeen = this.sheet.marksVersion;
      this.marks.array.set(marks);
      this.marks.needsUpdate = true;
      this.points[1].visible = marks.some((mark) => mark & ~DIMMED);
    }
  }
}

function bytes(n) {
  const attribute = new BufferAttribute(new Uint8Array(n), 1);
  attribute.gpuType = IntType; // handed to the shader as integers
  attribute.setUsage(DynamicDrawUsage);
  return attribute;
}
