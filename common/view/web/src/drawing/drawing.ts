// The picture: splats, marks over them and labels, drawn only when something changed.

import { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { Answer, Description, Goal, Photo, Vector } from "../network";
import { Camera } from "./camera";
import { Cells } from "./cells";
import { boxOf, type Change, Marks } from "./marks";
import { Frames } from "./frames";
import { Places } from "./places";

const MAX_LABELS = 8;
/** Largest distance between a click and the mark it means. */
const NEAR_PX = 14;

export class Drawing {
  readonly camera: Camera;
  readonly cells: Cells;
  readonly marks: Marks;
  readonly places: Places;
  /** Side of a square of the grid. */
  stepM = 1;
  private readonly renderer: THREE.WebGLRenderer;
  private readonly scene = new THREE.Scene();
  /**
   * Holds everything in world metres, moved so that the scene's middle is at the origin: the GPU has 32-bit
   * floats.
   */
  private readonly world = new THREE.Group();
  private readonly box = new THREE.Box3();
  private readonly up: THREE.Vector3;
  private readonly isDark = matchMedia("(prefers-color-scheme: dark)");
  private answers: Answer[] = [];
  private isDirty = true;
  private readonly frames: Frames;
  private waiting: (() => void)[] = [];

  /** `onSlow` is told which share of the Gaussians would be drawn fast enough. */
  constructor(private readonly canvas: HTMLCanvasElement, private readonly labels: HTMLElement, description: Description, onLeavePhoto: () => void, onSlow: (share: number) => void) {
    this.frames = new Frames(onSlow);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.up = new THREE.Vector3(...description.up).normalize();
    for (const cell of description.cells) this.box.union(new THREE.Box3(new THREE.Vector3(...cell.box_m.min), new THREE.Vector3(...cell.box_m.max)));
    if (this.box.isEmpty()) this.box.set(new THREE.Vector3(-1, -1, -1), new THREE.Vector3(1, 1, 1));
    this.world.position.copy(this.box.getCenter(new THREE.Vector3())).negate();
    this.scene.add(new SparkRenderer({ renderer: this.renderer, onDirty: () => this.redraw() }), this.world);
    this.cells = new Cells(this.world, this.box, this.up);
    this.marks = new Marks(this.world);
    this.places = new Places(this.world);
    this.camera = new Camera(canvas, this.up, () => this.redraw(), onLeavePhoto);
    const themed = () => {
      this.scene.background = new THREE.Color(this.isDark.matches ? 0x14181d : 0xeceff2);
      this.stepM = this.marks.showGround(this.box, this.up, description.geographic, this.isDark.matches);
      this.redraw();
    };
    themed();
    this.isDark.addEventListener("change", themed);
    this.marks.showCells(description.cells);
    this.marks.showPhotos(description.views, this.radiusM / 40);
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.showWhole(true);
    this.renderer.setAnimationLoop((nowMs) => this.step(nowMs));
  }

  redraw(): void {
    this.isDirty = true;
  }

  /** Calls back once, after the next frame. */
  onceDrawn(then: () => void): void {
    this.waiting.push(then);
    this.redraw();
  }

  stop(): void {
    this.renderer.setAnimationLoop(null);
    this.cells.clear();
    this.renderer.dispose();
  }

  showWhole(atOnce = false): void {
    const pose = this.camera.frame(new THREE.Vector3(), this.radiusM * 0.75, new THREE.Vector3(-0.5, -1, 0));
    if (atOnce) this.camera.place(...pose);
    else this.camera.flyTo(...pose);
    this.redraw();
  }

  showAnswers(name: string, answers: Answer[], chosen: number | null): void {
    this.answers = answers;
    this.marks.showAnswers(answers, chosen);
    this.labels.replaceChildren(...answers.slice(0, MAX_LABELS).map((answer) => {
      const label = document.createElement("span");
      label.textContent = `${name} ${answer.score.toFixed(2)}`;
      return label;
    }));
    this.redraw();
  }

  flyToAnswer(answer: Answer): void {
    const box = boxOf(answer);
    this.flyTo(new THREE.Vector3(...box.centre), new THREE.Vector3(...box.size));
  }

  flyToBox({ min, max }: { min: Vector; max: Vector }): void {
    const [low, high] = [new THREE.Vector3(...min), new THREE.Vector3(...max)];
    this.flyTo(low.clone().add(high).multiplyScalar(0.5), high.sub(low));
  }

  showChanges(changes: Change[]): void {
    this.marks.showChanges(changes);
    this.redraw();
  }

  /** Index of the answer under a point of the canvas. */
  answerAt(xPx: number, yPx: number): number | null {
    const caster = new THREE.Raycaster();
    caster.setFromCamera(new THREE.Vector2((xPx / this.canvas.clientWidth) * 2 - 1, 1 - (yPx / this.canvas.clientHeight) * 2), this.camera.camera);
    const hit = caster.intersectObjects(this.marks.boxes.children.filter((child) => child instanceof THREE.Mesh))[0];
    return hit ? (hit.object.userData.index as number) : null;
  }

  /** Takes a photo's camera, so that the picture laid over the canvas fits. */
  standAt(photo: Photo): void {
    const flipped = new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(1, 0, 0), Math.PI);
    const rotation = new THREE.Quaternion(...photo.rotation_xyzw).multiply(flipped);
    const aspect = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1);
    // A canvas narrower than the photo shows all of its width.
    const halfHeight = Math.max(photo.height_px, photo.width_px / aspect) / 2;
    const fieldOfViewDeg = (Math.atan(halfHeight / photo.focal_px) * 360) / Math.PI;
    const position = new THREE.Vector3(...photo.position_m).add(this.world.position);
    this.camera.standAt(position, rotation, fieldOfViewDeg, Math.max(this.radiusM * 0.2, 0.5));
    this.redraw();
  }

  /** Index of the photo whose camera is under a point of the canvas, if photos are shown. */
  photoAt(photos: Photo[], xPx: number, yPx: number): number | null {
    if (!this.marks.photos.visible) return null;
    return this.nearest(photos.map((photo) => photo.position_m), xPx, yPx);
  }

  /** Index of the place to stand under a point of the canvas. */
  placeUnder(goals: Goal[], xPx: number, yPx: number): number | null {
    return this.nearest(goals.map((goal) => goal.position_in_world), xPx, yPx);
  }

  /** Looks as a robot at a place does, at the thing. */
  lookFrom(goal: Goal, thing: Vector): void {
    const local = (point: Vector) => new THREE.Vector3(...point).add(this.world.position);
    this.camera.flyTo(local(goal.sensor_in_world), local(thing));
    this.redraw();
  }

  showRobot(description: Description): void {
    this.marks.showRobot(description, this.up);
    this.redraw();
  }

  pose(): { position: Vector; target: Vector } {
    const world = (local: THREE.Vector3) => local.clone().sub(this.world.position).toArray() as Vector;
    return { position: world(this.camera.camera.position), target: world(this.camera.controls.target) };
  }

  placeAt(pose: { position: Vector; target: Vector }): void {
    const local = (point: Vector) => new THREE.Vector3(...point).add(this.world.position);
    this.camera.place(local(pose.position), local(pose.target));
    this.redraw();
  }

  /** Index of the point of the world that is drawn within a few pixels of a point of the canvas. */
  private nearest(points: Vector[], xPx: number, yPx: number): number | null {
    const distances = points.map((place) => {
      const point = new THREE.Vector3(...place).add(this.world.position).project(this.camera.camera);
      const [x, y] = [((point.x + 1) / 2) * this.canvas.clientWidth, ((1 - point.y) / 2) * this.canvas.clientHeight];
      return Math.abs(point.z) > 1 ? Infinity : Math.hypot(x - xPx, y - yPx);
    });
    const nearest = distances.indexOf(Math.min(...distances));
    return nearest >= 0 && distances[nearest] < NEAR_PX ? nearest : null;
  }

  private flyTo(centre: THREE.Vector3, size: THREE.Vector3): void {
    this.camera.flyTo(...this.camera.frame(centre.add(this.world.position), Math.max(size.length() * 1.5, 0.5)));
    this.redraw();
  }

  private get radiusM(): number {
    return this.box.getSize(new THREE.Vector3()).length() / 2;
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.camera.updateProjectionMatrix();
    this.redraw();
  }

  private step(nowMs: number): void {
    if (this.camera.step(nowMs)) this.redraw();
    this.frames.count(nowMs, this.camera.isMoving && this.isDirty);
    if (!this.isDirty) return;
    this.isDirty = false;
    this.renderer.render(this.scene, this.camera.camera);
    this.placeLabels();
    for (const then of this.waiting.splice(0)) then();
  }

  /** Puts labels above their boxes; one that would cover a better answer's is left out. */
  private placeLabels(): void {
    const taken: [number, number][] = [];
    [...this.labels.children].forEach((label, i) => {
      const answer = this.answers[i];
      if (!answer || !(label instanceof HTMLElement)) return;
      const box = boxOf(answer);
      const point = new THREE.Vector3(...box.centre).addScaledVector(this.up, box.size[2] / 2).add(this.world.position).project(this.camera.camera);
      const [xPx, yPx] = [((point.x + 1) / 2) * this.canvas.clientWidth, ((1 - point.y) / 2) * this.canvas.clientHeight - 24];
      const isCovering = taken.some(([x, y]) => Math.abs(x - xPx) < label.offsetWidth + 4 && Math.abs(y - yPx) < 24);
      label.style.visibility = point.z > 1 || isCovering || !this.marks.boxes.visible ? "hidden" : "visible";
      label.style.transform = `translate(${xPx}px, ${yPx}px)`;
      if (!isCovering) taken.push([xPx, yPx]);
    });
  }
}
