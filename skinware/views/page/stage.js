// The place where the skin is drawn: camera, canvases, and a frame only when something has changed.

import { Matrix4, OrbitControls, PerspectiveCamera, Spherical, Vector3 } from "./vendor/three.min.js";
import { Flat } from "./flat.js";
import { eyeOf } from "./framing.js";
import { outlinesOf } from "./skin.js";
import { Solid } from "./solid.js";

const VIEW_ANGLE = 35; // degrees, from the bottom of the picture to its top
const FILLED = 0.95; // part of the picture that the taxels fill
const BELOW = 44; // CSS pixels, of the scale
const ABOVE = 26; // of names
const SLOW_MS = 55;
const QUICK_MS = 24;
const RATIOS = [0.75, 1, 1.5, 2];

export class Stage {
  #asked = false;
  #interval_ms = 33;
  #last = 0;
  #calm = 0;

  /**
   * @param {HTMLElement} host what the canvases fill.
   * @param {object} options `flat`: without WebGL; `sharp`: in all pixels, however slow; `theme`; `drawOver(stage)`:
   *     draws over each frame; `moved()`: the eye moved; `resized()`: the view, which was not turned, has another
   *     size now; `changed()`: taxels are drawn another way now.
   */
  constructor(host, options) {
    this.host = host;
    this.options = options;
    this.theme = options.theme;
    this.sheets = [];
    this.meshes = [];
    this.drawn = 0;
    this.fps = 0;
    this.camera = new PerspectiveCamera(VIEW_ANGLE, 1, 0.001, 100);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0, -1, 0.6);
    this.controls = new OrbitControls(this.camera, host);
    this.controls.enableDamping = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.controls.dampingFactor = 0.2;
    this.controls.zoomToCursor = true;
    this.isTurned = false; // by a person: the view is theirs
    let isHeld = false;
    this.controls.addEventListener("start", () => (isHeld = true));
    this.controls.addEventListener("end", () => (isHeld = false));
    this.controls.addEventListener("change", () => {
      this.isTurned ||= isHeld;
      options.moved?.();
      this.ask();
    });
    this.matrix = new Matrix4(); // from places to the picture
    this.ratio = Math.min(devicePixelRatio, 2);
    this.#choose(options.flat);
    new ResizeObserver(() => this.resize()).observe(host);
    this.resize();
  }

  /** Whether taxels are drawn by WebGL. */
  get isSolid() {
    return this.view instanceof Solid;
  }

  #choose(flat) {
    this.view?.dispose();
    try {
      this.view = flat ? new Flat(this.host, this.theme) : new Solid(this.host, this.theme, this.camera);
    } catch {
      this.view = new Flat(this.host, this.theme);
    }
    this.view.onlost = () => {
      this.#choose(true);
      this.resize();
      this.options.changed?.();
    };
    this.view.setSheets(this.sheets);
    this.view.setMeshes(this.meshes);
  }

  setSheets(sheets) {
    this.sheets = sheets;
    this.view.setSheets(sheets);
    this.ask();
  }

  setMeshes(meshes) {
    this.meshes = meshes;
    this.view.setMeshes(meshes);
    this.ask();
  }

  setTheme(theme) {
    this.theme = theme;
    this.view.setTheme(theme);
    this.ask();
  }

  /** Values have changed. */
  update() {
    this.view.update();
    this.ask();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!width || !height) return;
    this.width = width;
    this.height = height;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.view.resize(width, height, this.ratio);
    if (!this.isTurned) this.options.resized?.();
    this.ask();
  }

  /** Draw a frame soon. */
  ask() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.#asked = false;
    this.controls.update();
    this.#pace(now);
    this.draw();
    this.drawn++;
  }

  /** Draw now. */
  draw() {
    this.#see();
    this.view.render(this.camera);
    this.options.drawOver?.(this);
  }

  /** Fewer pixels while frames come slowly, more when there is time again. */
  #pace(now) {
    const passed = now - this.#last;
    this.#last = now;
    if (passed > 400) return; // nothing was to be drawn
    this.#interval_ms += 0.1 * (passed - this.#interval_ms);
    this.fps = 1000 / this.#interval_ms;
    if (this.options.sharp || ++this.#calm < 20) return;
    const best = Math.min(devicePixelRatio, 2);
    const at = RATIOS.findIndex((ratio) => ratio >= this.ratio);
    let ratio = this.ratio;
    if (this.#interval_ms > SLOW_MS && at > 0) ratio = RATIOS[at - 1];
    if (this.#interval_ms < QUICK_MS && this.ratio < best) ratio = Math.min(RATIOS[at + 1] ?? best, best);
    if (ratio === this.ratio) return;
    this.#calm = 0;
    this.ratio = ratio;
    this.view.resize(this.width, this.height, ratio);
  }

  #see() {
    this.camera.updateMatrixWorld();
    this.matrix.multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
  }

  /** Where a place is on the canvas: [x, y, depth], CSS pixels and m. */
  project(x, y, z) {
    const m = this.matrix.elements;
    const depth = m[3] * x + m[7] * y + m[11] * z + m[15];
    const right = (m[0] * x + m[4] * y + m[8] * z + m[12]) / depth;
    const up = (m[1] * x + m[5] * y + m[9] * z + m[13]) / depth;
    return [(0.5 + 0.5 * right) * this.width, (0.5 - 0.5 * up) * this.height, depth];
  }

  /** CSS pixels of 1 m at a distance of 1 m. */
  get pixels() {
    return this.height / (2 * Math.tan((VIEW_ANGLE * Math.PI) / 360));
  }

  /**
   * Have some taxels fill the picture.
   * @param {(sheet, i) => boolean} isIn which.
   * @param {?number[]} from direction from them to the eye; null: as it is.
   * @param {boolean} isAll the hands around them are to be seen, too.
   */
  frame(isIn, from = null, isAll = false) {
    const towards = from ?? this.camera.position.clone().sub(this.controls.target).toArray();
    const around = isAll ? outlinesOf(this.sheets) : [];
    const eye = eyeOf([...this.sheets, ...around], (sheet, i) => around.includes(sheet) || isIn(sheet, i), towards, this.picture);
    if (eye) this.look(new Vector3(...eye.position), new Vector3(...eye.target));
  }

  /** Look from a place at another. */
  look(position, target) {
    this.controls.target.copy(target);
    this.camera.position.copy(position);
    const distance = this.camera.position.distanceTo(this.controls.target);
    this.camera.near = distance / 200;
    this.camera.far = distance * 50;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.#see();
    this.ask();
  }

  /** Go around what is looked at, rad, and nearer to it (below 1) or away. */
  orbit(around, up, zoom = 1) {
    this.isTurned = true;
    const eye = new Spherical().setFromVector3(yUp(this.camera.position.clone().sub(this.controls.target)));
    eye.theta += around;
    eye.phi += up;
    eye.radius *= zoom;
    eye.makeSafe();
    this.look(zUp(new Vector3().setFromSpherical(eye)).add(this.controls.target), this.controls.target.clone());
  }

  /** Where the edges of the picture are, 1 m ahead of the eye; what is below it needs a strip of its own. */
  get picture() {
    const tall = FILLED * Math.tan((VIEW_ANGLE * Math.PI) / 360);
    const wide = tall * this.camera.aspect;
    const [above, below] = [ABOVE, BELOW].map((room) => Math.min(room / this.height, 0.2));
    return { right: wide, left: wide, top: tall * (1 - 2 * above), bottom: tall * (1 - 2 * below) };
  }
}

const yUp = ({ x, y, z }) => new Vector3(x, z, -y);
const zUp = ({ x, y, z }) => new Vector3(x, -z, y);
