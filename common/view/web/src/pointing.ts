// What the pointer and keys do over the scene: choosing, hovering, measuring two points.

import { lengthText } from "./answers";
import type { Asking } from "./asking";
import { isForScene } from "./drawing/camera";
import type { Drawing } from "./drawing/drawing";
import { type Description, fetchObjectAt, type Vector } from "./network";
import { note, panel } from "./panel";
import type { PlacesToStand } from "./places";
import { nextTheme } from "./theme";

const HOVER_AFTER_MS = 120;
/** A pointer that moved more while it was down turned the scene. */
const CLICK_PX = 5;

export class Pointing {
  private measured: Vector[] = [];
  private hovering = 0;
  private downAt: [number, number] = [0, 0];

  constructor(private readonly drawing: Drawing, private readonly asking: Asking, private readonly places: PlacesToStand, private readonly description: () => Description) {
    const { canvas } = panel;
    canvas.addEventListener("pointerdown", (event) => {
      this.downAt = [event.offsetX, event.offsetY];
      this.hideHover();
    });
    canvas.addEventListener("click", (event) => {
      if (Math.hypot(event.offsetX - this.downAt[0], event.offsetY - this.downAt[1]) <= CLICK_PX) void this.click(event.offsetX, event.offsetY);
    });
    canvas.addEventListener("pointermove", (event) => {
      this.hideHover();
      if (event.buttons === 0 && event.pointerType === "mouse") this.hovering = window.setTimeout(() => this.hover(event.offsetX, event.offsetY), HOVER_AFTER_MS);
    });
    canvas.addEventListener("pointerleave", () => this.hideHover());
    panel.measure.addEventListener("click", () => this.measure());
    panel.theme.addEventListener("click", nextTheme);
    panel.help.addEventListener("click", () => this.help());
    document.addEventListener("pointerdown", (event) => {
      if (!panel.layers.contains(event.target as Node)) panel.layers.open = false;
    });
    panel.whole.addEventListener("click", () => drawing.showOpening());
    document.addEventListener("keydown", (event) => this.key(event));
  }

  private get isMeasuring(): boolean {
    return panel.measure.getAttribute("aria-pressed") === "true";
  }

  private measure(isOn = !this.isMeasuring): void {
    panel.measure.setAttribute("aria-pressed", String(isOn));
    this.measured = [];
    this.drawing.showMeasured([], "");
    note(isOn ? "Click two points of the scene." : "", false, true);
  }

  private async click(xPx: number, yPx: number): Promise<void> {
    const { drawing } = this;
    if (this.isMeasuring) return this.measureTo(drawing.surfaceAt(xPx, yPx)?.point ?? null);
    if (this.places.chooseAt(xPx, yPx)) return;
    const { views, program } = this.description();
    const photo = drawing.photoAt(views, xPx, yPx);
    if (photo !== null) {
      this.asking.choose(null);
      await this.asking.openPhoto(photo, null);
      return drawing.standAt(views[photo]);
    }
    const index = drawing.answerAt(xPx, yPx);
    if (index !== null) return this.asking.choose(index);
    const surface = program === "slag-edge" ? drawing.surfaceAt(xPx, yPx) : null;
    const object = surface && (await fetchObjectAt(surface.point).catch(() => null));
    if (object) this.asking.showObject(object);
  }

  private measureTo(point: Vector | null): void {
    if (!point) return note("Nothing there: click on a surface.", false, true);
    this.measured = this.measured.length === 1 ? [this.measured[0], point] : [point];
    const [a, b] = this.measured;
    const text = b ? lengthText(Math.hypot(...a.map((v, i) => v - b[i])), this.description().metric) : "from here";
    this.drawing.showMeasured(this.measured, text);
    note(b ? `${text} between the two points.` : "Click the second point.", false, true);
  }

  private hover(xPx: number, yPx: number): void {
    const surface = this.drawing.surfaceAt(xPx, yPx);
    if (!surface) return;
    const height = `${lengthText(Math.max(surface.heightM, 0), this.description().metric)} above ground`;
    panel.hover.textContent = surface.score === null ? height : `score ${surface.score.toFixed(2)} · ${height}`;
    panel.hover.hidden = false;
    const { offsetWidth, offsetHeight } = panel.hover;
    panel.hover.style.transform = `translate(${Math.min(xPx + 14, innerWidth - offsetWidth - 8)}px, ${Math.min(yPx + 14, innerHeight - offsetHeight - 8)}px)`;
  }

  private hideHover(): void {
    clearTimeout(this.hovering);
    panel.hover.hidden = true;
  }

  private help(): void {
    panel.layers.open = false;
    panel.keys.showModal();
  }

  /** Leaves what was opened last. */
  private leave(): void {
    if (panel.layers.open) panel.layers.open = false;
    else if (this.isMeasuring) this.measure(false);
    else this.asking.choose(null);
  }

  private key(event: KeyboardEvent): void {
    if (!isForScene(event)) return;
    const acts: Record<string, () => void> = {
      "/": () => panel.question.focus(), "?": () => this.help(), r: () => this.drawing.showOpening(), m: () => this.measure(), t: nextTheme,
      b: () => panel.showBoxes.click(), g: () => panel.showGrid.click(), p: () => panel.showPhotos.click(),
      Escape: () => this.leave(),
    };
    const act = /^[1-9]$/.test(event.key) ? () => this.asking.choose(Number(event.key) - 1) : acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}
