// The view by WebGL 2: discs in space, and the meshes of links.

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DataTexture,
  DirectionalLight,
  HemisphereLight,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  Scene,
  WebGLRenderer,
} from "./vendor/three.min.js";
import { Cloud, discs } from "./cloud.js";
import { BODY, GROUND, INK, ramp } from "./palette.js";
import { outlinesOf } from "./skin.js";

export class Solid {
  #clouds = [];
  #meshes = [];

  /** @throws {Error} this browser has no WebGL 2. */
  constructor(host, theme) {
    this.canvas = document.createElement("canvas");
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: false, alpha: false, stencil: false });
    host.prepend(this.canvas);
    this.canvas.addEventListener("webglcontextlost", () => this.onlost?.());
    this.scene = new Scene();
    this.scene.add(new HemisphereLight(0xffffff, 0x445066, 2.2));
    this.light = new DirectionalLight(0xffffff, 1.2);
    this.scene.add(this.light);
    this.ramp = new DataTexture(ramp(theme), 256, 1);
    this.discs = discs(this.ramp);
    this.uniforms = this.discs[0].uniforms;
    this.linkMaterial = new MeshLambertMaterial({ flatShading: true });
    this.bodyMaterial = new MeshLambertMaterial({ color: 0 }); // in one colour, whatever the light
    this.body = new Mesh(new BufferGeometry(), this.bodyMaterial);
    this.scene.add(this.body);
    this.setTheme(theme);
  }

  setTheme(theme) {
    this.ramp.image.data.set(ramp(theme));
    this.ramp.needsUpdate = true;
    const unit = (rgb) => rgb.map((x) => x / 255);
    this.uniforms.ground.value = unit(GROUND[theme]);
    this.uniforms.ink.value = unit(INK[theme]);
    this.renderer.setClearColor(cssColour(GROUND[theme]));
    this.bodyMaterial.emissive = cssColour(BODY[theme]);
    this.linkMaterial.color = cssColour(GROUND[theme].map((x, c) => x + 0.22 * (INK[theme][c] - x)));
  }

  setSheets(sheets) {
    for (const cloud of this.#clouds) {
      this.scene.remove(...cloud.points);
      cloud.geometry.dispose();
    }
    this.#clouds = sheets.map((sheet) => new Cloud(sheet, this.discs));
    for (const cloud of this.#clouds) this.scene.add(...cloud.points);
    this.body.geometry.dispose();
    this.body.geometry = new BufferGeometry();
    this.body.geometry.setAttribute("position", new BufferAttribute(trianglesOf(outlinesOf(sheets)), 3));
    this.body.geometry.computeVertexNormals();
  }

  /** @param {{geometry: object, pose: number[]}[]} meshes `pose`: 4 x 4, row by row. */
  setMeshes(meshes) {
    for (const mesh of this.#meshes) this.scene.remove(mesh);
    this.#meshes = meshes.map(({ geometry, pose }) => {
      const mesh = new Mesh(geometry, this.linkMaterial);
      mesh.applyMatrix4(new Matrix4().set(...pose));
      return mesh;
    });
    for (const mesh of this.#meshes) this.scene.add(mesh);
  }

  update() {
    for (const cloud of this.#clouds) cloud.update();
  }

  resize(width, height, ratio) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  render(camera) {
    const halfAngle = (camera.fov * Math.PI) / 360;
    this.uniforms.pixels.value = this.canvas.height / (2 * Math.tan(halfAngle));
    this.light.position.copy(camera.position);
    this.renderer.render(this.scene, camera);
  }

  dispose() {
    this.onlost = null;
    this.setSheets([]);
    this.renderer.dispose();
    this.canvas.remove();
  }
}

/** The triangles between the first corner of each outline and the others. */
function trianglesOf(outlines) {
  const corners = [];
  for (const { n, position } of outlines) {
    for (let k = 1; k + 1 < n; k++) for (const i of [0, k, k + 1]) corners.push(...position.subarray(3 * i, 3 * i + 3));
  }
  return Float32Array.from(corners);
}

function cssColour(rgb) {
  return new Color(`rgb(${rgb.map(Math.round).join(",")})`);
}
