// A photo dropped on a robot's page: the robot finds where it was taken, and the page goes there.

import type { Asking } from "./asking";
import type { Drawing } from "./drawing/drawing";
import { type Description, locatePhoto, type Photo } from "./network";
import { note, panel } from "./panel";

/** Across photos of a camera that the scene does not know, about that of phones and drones. */
const FIELD_OF_VIEW_DEG = 65;
/** Relative difference of two aspect ratios that may be rounding. */
const SAME_ASPECT = 0.01;

export class Dropping {
  constructor(private readonly drawing: Drawing, private readonly asking: Asking, private readonly description: () => Description, private readonly report: (error: unknown) => void) {
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      void this.take(event.dataTransfer?.files[0]);
    });
    panel.locate.addEventListener("click", () => panel.photo.click());
    panel.photo.addEventListener("change", () => {
      void this.take(panel.photo.files?.[0]);
      panel.photo.value = "";
    });
  }

  private async take(file: File | undefined): Promise<void> {
    if (!file) return;
    if (this.description().program !== "slag-edge") return note("Only a robot's page finds where a photo was taken.");
    try {
      // The robot sees pixels as they are stored.
      const { width, height } = await createImageBitmap(file, { imageOrientation: "none" });
      this.asking.choose(null);
      const focalPx = this.focalOf(width, height);
      this.askFocal(file, width, height, focalPx);
      await this.find(file, width, height, focalPx);
    } catch (error) {
      this.report(error instanceof DOMException ? new Error(`${file.name} is no picture.`) : error);
    }
  }

  /** Focal length of the scene's own camera if its photos have these sides, else of a common one; pixels. */
  private focalOf(width: number, height: number): number {
    const isAlike = (view: Photo) => Math.abs((view.width_px * height) / (view.height_px * width) - 1) < SAME_ASPECT;
    const own = this.description().views.find(isAlike);
    return own ? (own.focal_px * width) / own.width_px : width / 2 / Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  }

  /** Lets a person correct the focal length. */
  private askFocal(file: File, width: number, height: number, focalPx: number): void {
    const form = document.createElement("form");
    const label = document.createElement("label");
    const input = document.createElement("input");
    Object.assign(input, { type: "number", min: "1", step: "any", required: true, value: focalPx.toFixed(1) });
    label.append(`Focal length of ${file.name} (${width} × ${height}), px `, input);
    const button = document.createElement("button");
    button.textContent = "Find its place";
    form.append(label, button);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.find(file, width, height, Number(input.value)).catch(this.report);
    });
    panel.details.replaceChildren(form);
    panel.details.hidden = false;
  }

  private async find(file: File, width: number, height: number, focalPx: number): Promise<void> {
    note("Looking for the photo's place…", false, true);
    const located = await locatePhoto(file, focalPx);
    if (located.state !== "found") return note(`${located.state === "lost" ? "Lost" : "Unsure"}: ${located.reason}`, false, true);
    const photo: Photo = { name: file.name, position_m: located.position_in_world, rotation_xyzw: located.optical_rotation_xyzw, width_px: width, height_px: height, focal_px: focalPx, has_picture: true };
    this.drawing.standAt(photo);
    await this.asking.layOver(photo, Promise.resolve(URL.createObjectURL(file)), null);
    note(located.verified_by === "rendering" ? "Found: the scene looks like the photo from here." : `Found by ${located.n_inliers} landmarks.`);
  }
}
