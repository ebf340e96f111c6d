// The small known scene of `service.mjs` as tests see it: its page opened, and where its points are on the screen.

import { litPixels as litBeside, opened as openedAt } from "./browser.mjs";
import { startService } from "./service.mjs";

export const [WIDTH, HEIGHT] = [1100, 640];
export const PANEL_PX = 360;
export const POSITION = [0.5, -6, 4];
export const TARGET = [0, 0, 0.5];
export const CAMERA = [...POSITION, ...TARGET].join(",");
const FIELD_OF_VIEW_DEG = 55;

/** A page of a fresh service. */
export async function opened(run, { behaviour = {}, ...how } = {}) {
  const service = await startService(behaviour);
  try {
    await openedAt(service.url, (page) => run(page, service), how);
  } finally {
    await service.stop();
  }
}

export const litPixels = (page, name) => litBeside(page, PANEL_PX, name);

export const drawn = (page) => page.waitForFunction(() => document.documentElement.dataset.gaussians === "7360", null, { timeout: 30000 });
export const answered = (page, question) => page.waitForFunction((q) => document.documentElement.dataset.answered === q, question, { timeout: 30000 });

/** Where the camera is and what it looks at, as the address says. */
export async function cameraOf(page) {
  await page.click("#copy-link");
  const numbers = new URLSearchParams(new URL(page.url()).hash.slice(1)).get("camera").split(",").map(Number);
  return [numbers.slice(0, 3), numbers.slice(3)];
}

export const minus = (a, b) => a.map((v, i) => v - b[i]);
export const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];
const unit = (v) => v.map((x) => x / Math.hypot(...v));

/** Pixel of a world point, computed apart from the page: the camera looks at the middle of what the panel leaves free. */
export function project(point, from = POSITION, to = TARGET) {
  const forward = unit(minus(to, from));
  const right = unit(cross(forward, [0, 0, 1]));
  const ray = minus(point, from);
  const focal = HEIGHT / 2 / Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  const depth = dot(ray, forward);
  return [(PANEL_PX + WIDTH) / 2 + (focal * dot(ray, right)) / depth, HEIGHT / 2 - (focal * dot(ray, cross(right, forward))) / depth];
}

const outlines = new Map();

/** Directions, and how far the projected corners of a box reach along each. */
function outlineOf(thing) {
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => project(thing.min.map((low, k) => ((i >> k) & 1 ? thing.max[k] : low))));
  return Array.from({ length: 72 }, (_, i) => {
    const [dx, dy] = [Math.cos((i * Math.PI) / 36), Math.sin((i * Math.PI) / 36)];
    return [dx, dy, Math.max(...corners.map(([cx, cy]) => cx * dx + cy * dy))];
  });
}

/** The true mask: pixels inside the hull of a box's projected corners, which `grownPx` moves outward. */
export function isInside(thing, [x, y], grownPx) {
  if (!outlines.has(thing)) outlines.set(thing, outlineOf(thing));
  // Inside the hull if no direction separates the point from all corners.
  return outlines.get(thing).every(([dx, dy, reach]) => x * dx + y * dy <= reach + grownPx);
}

