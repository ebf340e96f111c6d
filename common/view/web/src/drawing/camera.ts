// The camera: turning around a point, flying with keys, and gliding to a place.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

export const FIELD_OF_VIEW_DEG = 55;
/** Sines of the angles from which a thing is framed. */
const [LEAST_RISE, MOST_RISE] = [0.35, 0.95];
const GLIDE_MS = 700;
const KEYS = ["KeyW", "KeyS", "KeyA", "KeyD", "KeyQ", "KeyE", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"];

/** Whether a key is for the scene: boxes for text take all keys, dialogs too, and sliders take arrows. */
export function isForScene({ target, code, ctrlKey, metaKey, altKey }: KeyboardEvent): boolean {
  const type = target instanceof HTMLInputElement ? target.type : "";
  const isTaken = target instanceof HTMLTextAreaElement || (type === "range" ? code.startsWith("Arrow") : type !== "" && type !== "checkbox");
  return !isTaken && !ctrlKey && !metaKey && !altKey && !document.querySelector("dialog[open]");
}

interface Glide {
  startMs: number;
  from: [THREE.Vector3, THREE.Vector3];
  to: [THREE.Vector3, THREE.Vector3];
}

export class Camera {
  readonly camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.02, 5000);
  readonly controls: OrbitControls;
  private readonly pressed = new Set<string>();
  private glide: Glide | null = null;
  private lastMs = 0;
  private isAtPhoto = false;
  private isDragged = false;
  /** Vertical angle of the part of the picture that nothing covers. */
  private fieldOfViewDeg = FIELD_OF_VIEW_DEG;
  private size: [number, number] = [1, 1];
  /** What covers the picture at its left and at its bottom, pixels. */
  private covered: [number, number] = [0, 0];

  /** `onLeave` is called when the camera leaves a photo's pose. */
  constructor(canvas: HTMLCanvasElement, private readonly up: THREE.Vector3, onMove: () => void, private readonly onLeave: () => void) {
    this.camera.up.copy(up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", onMove);
    this.controls.addEventListener("start", () => {
      this.glide = null;
      this.leavePhoto();
      this.isDragged = this.wasMoved = true;
    });
    this.controls.addEventListener("end", () => (this.isDragged = false));
    document.addEventListener("keydown", (event) => {
      if (!KEYS.includes(event.code) || !isForScene(event)) return;
      event.preventDefault();
      this.glide = null;
      this.leavePhoto();
      this.pressed.add(event.code);
      this.wasMoved = true;
      onMove();
    });
    document.addEventListener("keyup", (event) => this.pressed.delete(event.code));
    addEventListener("blur", () => this.pressed.clear());
  }

  /** The middle of what is not covered is what the camera looks at. */
  resize(size: [number, number], covered: [number, number]): void {
    [this.size, this.covered] = [size, covered];
    this.project();
  }

  private project(): void {
    const [width, height] = this.size;
    const [left, bottom] = this.covered;
    this.camera.fov = (Math.atan(height / 2 / this.focalPx) * 360) / Math.PI;
    this.camera.aspect = width / height;
    this.camera.setViewOffset(width, height, -left / 2, bottom / 2, width, height);
  }

  get focalPx(): number {
    return (this.size[1] - this.covered[1]) / 2 / Math.tan((this.fieldOfViewDeg * Math.PI) / 360);
  }

  /** Breadth by height of what is not covered. */
  get aspect(): number {
    return (this.size[0] - this.covered[0]) / Math.max(this.size[1] - this.covered[1], 1);
  }

  place(position: THREE.Vector3, target: THREE.Vector3): void {
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.controls.update();
  }

  /**
   * Takes a photo's pose and field of view, until the camera is moved. `rotation`: world from camera as
   * three.js has it.
   */
  standAt(position: THREE.Vector3, rotation: THREE.Quaternion, fieldOfViewDeg: number, distance: number): void {
    this.glide = null;
    this.place(position, new THREE.Vector3(0, 0, -distance).applyQuaternion(rotation).add(position));
    // The controls keep the horizon level; a photo need not be.
    this.camera.quaternion.copy(rotation);
    this.fieldOfViewDeg = fieldOfViewDeg;
    this.project();
    this.isAtPhoto = true;
  }

  private leavePhoto(): void {
    if (!this.isAtPhoto) return;
    this.isAtPhoto = false;
    this.fieldOfViewDeg = FIELD_OF_VIEW_DEG;
    this.project();
    this.onLeave();
  }

  flyTo(position: THREE.Vector3, target: THREE.Vector3): void {
    this.leavePhoto();
    this.wasMoved = true;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return this.place(position, target);
    this.glide = { startMs: performance.now(), from: [this.camera.position.clone(), this.controls.target.clone()], to: [position, target] };
  }

  /** Distance from which a sphere fills what is not covered. */
  distanceOf(radiusM: number): number {
    return radiusM / Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360) / Math.min(this.aspect, 1);
  }

  /** Looks at a sphere from the side and the height at which the camera is, a little from above at least. */
  frame(centre: THREE.Vector3, radiusM: number): [THREE.Vector3, THREE.Vector3] {
    const away = this.camera.position.clone().sub(centre);
    const height = Math.min(Math.max(away.normalize().dot(this.up), LEAST_RISE), MOST_RISE);
    away.addScaledVector(this.up, -away.dot(this.up));
    if (away.lengthSq() < 1e-6) away.set(1, 0, 0);
    away.setLength(Math.sqrt(1 - height ** 2)).addScaledVector(this.up, height);
    return [centre.clone().addScaledVector(away, this.distanceOf(radiusM)), centre];
  }

  /** Moves on; true while it is under way. */
  step(nowMs: number): boolean {
    const seconds = Math.min((nowMs - this.lastMs) / 1000, 0.1);
    this.lastMs = nowMs;
    if (this.glide) {
      const share = Math.min((nowMs - this.glide.startMs) / GLIDE_MS, 1);
      const eased = share * share * (3 - 2 * share);
      const [from, to] = [this.glide.from, this.glide.to];
      if (share >= 1) this.glide = null;
      this.place(from[0].clone().lerp(to[0], eased), from[1].clone().lerp(to[1], eased));
    }
    if (this.pressed.size > 0) this.moveByKeys(seconds);
    return this.isUnderWay;
  }

  /** Whether a person moved it since it was placed. */
  wasMoved = false;

  private get isUnderWay(): boolean {
    return this.glide !== null || this.pressed.size > 0;
  }

  /** Whether it glides, or keys or a pointer move it. */
  get isMoving(): boolean {
    return this.isUnderWay || this.isDragged;
  }

  private moveByKeys(seconds: number): void {
    const held = (code: string) => (this.pressed.has(code) ? 1 : 0);
    const forward = this.controls.target.clone().sub(this.camera.position);
    const speedM = Math.max(forward.length(), 1) * seconds;
    forward.normalize();
    const right = forward.clone().cross(this.up).normalize();
    const move = forward.clone().multiplyScalar(held("KeyW") - held("KeyS")).addScaledVector(right, held("KeyD") - held("KeyA"))
      .addScaledVector(this.up, held("KeyE") - held("KeyQ")).multiplyScalar(speedM);
    const look = this.controls.target.clone().sub(this.camera.position);
    look.applyAxisAngle(this.up, (held("ArrowLeft") - held("ArrowRight")) * seconds);
    const tilted = look.clone().applyAxisAngle(right, (held("ArrowUp") - held("ArrowDown")) * seconds);
    if (Math.abs(tilted.clone().normalize().dot(this.up)) < 0.98) look.copy(tilted);
    const position = this.camera.position.clone().add(move);
    this.place(position, position.clone().add(look));
  }
}
