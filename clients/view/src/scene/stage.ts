// The picture: renderer, camera and its modes, one scene or two beside each other. It draws when asked to.
import { PCFShadowMap, PerspectiveCamera, SRGBColorSpace, Vector2, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { el } from "../dom";
import type { ViewState } from "../state";
import type { Vector } from "../types";
import { Labels } from "./labels";
import type { Pose } from "./pose";
import { rotate } from "./pose";
import type { Hit, RunView } from "./view";

const FIELD_OF_VIEW = 50;

/** Whether pictures are computed by the processor, which takes a second for each with shadows. */
export function isSoftware(): boolean {
  const context = el("canvas").getContext("webgl2");
  const info = context?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? String(context?.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export class Stage {
  readonly element = el("div", { class: "stage" });
  readonly canvas = el("canvas", { tabindex: 0, role: "img", "aria-label": "3D view of the world" });
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.3, 30_000);
  readonly controls: OrbitControls;
  private readonly renderer: WebGLRenderer;
  private readonly labels = new Labels();
  private views: RunView[] = [];
  private state: ViewState | null = null;
  private asked = false;
  private followed: Vector3 | null = null;
  /** Pictures that were drawn. */
  drawn = 0;

  /**
   * @param origin world coordinates of the scene's zero [m]
   * @param isFine whether there are shadows and smooth edges
   * @param onMove called when the reader has moved the camera
   * @param onPick called with what was clicked, and the number of the view
   */
  constructor(
    private readonly origin: Vector,
    isFine: boolean,
    onMove: () => void,
    onPick: (hit: Hit | null, view: number) => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: isFine });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.renderer.shadowMap.enabled = isFine;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.maxPolarAngle = 0.55 * Math.PI;
    this.controls.minDistance = 1;
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.render());
    this.controls.addEventListener("end", onMove);
    this.element.append(this.canvas, this.labels.element);
    new ResizeObserver(() => {
      this.measure();
      this.draw();
    }).observe(this.element);
    this.listenForClicks(onPick);
  }

  setViews(views: RunView[]): void {
    this.views = views;
    this.element.classList.toggle("two", views.length > 1);
    this.measure();
  }

  /** Draw from now on: what was asked for before has no camera. */
  start(): void {
    this.started = true;
    this.draw();
  }
  private started = false;

  setState(state: ViewState): void {
    if (state.mode !== this.state?.mode) {
      this.followed = null;
      if (state.mode !== "board") {
        this.controls.enabled = true;
        this.camera.fov = FIELD_OF_VIEW;
        this.camera.up.set(0, 0, 1);
        this.camera.updateProjectionMatrix();
      }
    }
    this.state = state;
  }

  /** Where the camera is [m, world]. */
  get place(): { position: Vector; target: Vector } {
    const world = (place: Vector3) => place.toArray().map((value, i) => value + this.origin[i]) as Vector;
    return { position: world(this.camera.position), target: world(this.controls.target) };
  }

  /** Move the camera [m, world]. */
  setPlace({ position, target }: { position: Vector; target: Vector }): void {
    this.camera.position.set(...(position.map((value, i) => value - this.origin[i]) as Vector));
    this.controls.target.set(...(target.map((value, i) => value - this.origin[i]) as Vector));
    this.controls.update();
    this.render();
  }

  /**
   * Follow a pose, or look from it, as the mode says.
   *
   * @param size of the object that has it [m]
   * @param fieldOfView of a camera, horizontally [rad]
   * @param keep whether the camera already is where it follows from
   */
  track(pose: Pose | null, size: Vector, fieldOfView: number | null, keep: boolean): void {
    const mode = this.state?.mode ?? "free";
    if (!pose || mode === "free") {
      this.followed = null;
      this.controls.enabled = true;
      return;
    }
    const at = new Vector3(...(pose.position.map((value, i) => value - this.origin[i]) as Vector));
    if (mode === "follow") {
      if (this.followed) {
        const moved = at.clone().sub(this.followed);
        this.camera.position.add(moved);
      } else if (!keep) {
        // From the same side, as near as shows the object in its street.
        const away = this.camera.position.clone().sub(this.controls.target).normalize();
        const distance = Math.min(Math.max(25, 6 * Math.max(...size)), this.camera.position.distanceTo(at));
        this.camera.position.copy(at).addScaledVector(away, distance);
      }
      this.controls.target.copy(at);
      this.followed = at;
      this.controls.update();
    } else {
      this.controls.enabled = false;
      const ahead = new Vector3(...rotate(pose.orientation, [1, 0, 0]));
      const up = new Vector3(...rotate(pose.orientation, [0, 0, 1]));
      // A camera looks from where it is, an object from above the front of its roof.
      if (fieldOfView === null) at.addScaledVector(ahead, 0.45 * size[0]).addScaledVector(up, 0.5 * size[2] + 0.4);
      this.camera.position.copy(at);
      this.camera.up.copy(up);
      this.controls.target.copy(at).addScaledVector(ahead, 10);
      this.camera.lookAt(this.controls.target);
      const wide = fieldOfView ?? (80 * Math.PI) / 180;
      this.camera.fov = (2 * Math.atan(Math.tan(wide / 2) / this.camera.aspect) * 180) / Math.PI;
      this.camera.updateProjectionMatrix();
    }
    this.render();
  }

  /** Shadows and pictures again, for the next frame. */
  refresh(): void {
    for (const { sun } of this.views) sun.shadow.needsUpdate = true;
    this.render();
  }

  /** Ask for a picture before the screen's next one. */
  render(): void {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      if (this.asked) this.draw();
    });
  }

  /** Draw now. */
  draw(): void {
    this.asked = false;
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height || !this.state || !this.started) return;
    const each = width / Math.max(1, this.views.length);
    // Depth buffers resolve little far from a camera whose nearest place is very near.
    const near = Math.max(0.15, Math.min(5, 0.004 * this.camera.position.distanceTo(this.controls.target)));
    if (near !== this.camera.near) {
      this.camera.near = near;
      this.camera.updateProjectionMatrix();
    }
    for (const { objects } of this.views) objects.enlarge(this.camera, height);
    this.renderer.setScissorTest(this.views.length > 1);
    let used = 0;
    this.views.forEach((view, i) => {
      this.renderer.setViewport(i * each, 0, each, height);
      this.renderer.setScissor(i * each, 0, each, height);
      this.renderer.render(view.scene, this.camera);
      if (this.state) used = this.labels.draw(view.labels(this.state), this.camera, i * each, each, height, used);
    });
    this.labels.finish(used);
    this.drawn++;
  }

  /** Draw what was asked for, and wait until it is there. */
  finish(): void {
    if (this.asked) this.draw();
    const context = this.renderer.getContext();
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** Middle of the picture: right of panels that cover so much of its left [px]. */
  setCovered(left: number): void {
    this.covered = left;
    this.measure();
  }
  private covered = 0;

  /** Take in the size of the page. */
  private measure(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(1, this.views.length) / height;
    if (this.views.length === 1) this.camera.setViewOffset(width, height, -this.covered / 2, 0, width, height);
    else this.camera.clearViewOffset();
    this.camera.updateProjectionMatrix();
  }

  /** Where a place in the world [m] is in the window [px]. */
  project(place: Vector): [number, number] {
    const at = new Vector3(...(place.map((value, i) => value - this.origin[i]) as Vector)).project(this.camera);
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    return [left + ((at.x + 1) / 2) * width, top + ((1 - at.y) / 2) * height];
  }

  /** A press that does not move is a click; the rest moves the camera. */
  private listenForClicks(onPick: (hit: Hit | null, view: number) => void): void {
    let pressed: { x: number; y: number } | null = null;
    this.canvas.addEventListener("pointerdown", ({ clientX: x, clientY: y }) => (pressed = { x, y }));
    this.canvas.addEventListener("pointerup", (event) => {
      if (!pressed || event.button !== 0 || Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) > 4) return;
      const box = this.canvas.getBoundingClientRect();
      const each = box.width / Math.max(1, this.views.length);
      const number = Math.min(this.views.length - 1, Math.floor((event.clientX - box.left) / each));
      const x = (event.clientX - box.left - number * each) / each;
      const y = (event.clientY - box.top) / box.height;
      const size = new Vector2(each, box.height);
      const at = new Vector2(2 * x - 1, 1 - 2 * y);
      onPick(this.views[number]?.pick(at, this.camera, size) ?? null, number);
    });
  }
}
