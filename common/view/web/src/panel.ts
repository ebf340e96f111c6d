// The panel's elements, and what is written in them.

import { lengthText } from "./answers";
import { PALETTES, rampColour } from "./drawing/ramp";
import type { Description, Vector } from "./network";
import { themeNow } from "./theme";

function element<T extends HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`index.html has no #${id}`);
  return found as T;
}

export const panel = {
  aside: element("panel"),
  sheet: element<HTMLButtonElement>("sheet"),
  canvas: element<HTMLCanvasElement>("canvas"),
  labels: element("labels"),
  hover: element("hover"),
  badge: element("badge"),
  robot: element("robot"),
  form: element<HTMLFormElement>("ask"),
  question: element<HTMLInputElement>("question"),
  second: element<HTMLInputElement>("second"),
  more: element<HTMLButtonElement>("more"),
  beside: element("beside"),
  chips: element("chips"),
  questionSuggestions: element("question-suggestions"),
  secondSuggestions: element("second-suggestions"),
  answers: element("answers"),
  details: element("details"),
  blend: element<HTMLImageElement>("blend"),
  threshold: element<HTMLInputElement>("threshold"),
  layers: element<HTMLDetailsElement>("layers"),
  showBoxes: element<HTMLInputElement>("show-boxes"),
  showGrid: element<HTMLInputElement>("show-grid"),
  showCells: element<HTMLInputElement>("show-cells"),
  showPhotos: element<HTMLInputElement>("show-photos"),
  showChanges: element<HTMLInputElement>("show-changes"),
  changes: element("changes"),
  copyLink: element<HTMLButtonElement>("copy-link"),
  measure: element<HTMLButtonElement>("measure"),
  theme: element<HTMLButtonElement>("theme"),
  help: element<HTMLButtonElement>("help"),
  keys: element<HTMLDialogElement>("keys"),
  locate: element<HTMLButtonElement>("locate"),
  photo: element<HTMLInputElement>("photo"),
  whole: element<HTMLButtonElement>("whole"),
};

/** Longer than the pause between two polls, so that an outage stays told. */
const NOTE_MS = 6000;

let noting = 0;
const count = new Intl.NumberFormat("en");

/** Says what came of the question. */
export function say(text: string, isError = false): void {
  element("message").textContent = text;
  element("message").classList.toggle("error", isError);
}

/** Says something else below that, for a while or until there is other news. */
export function note(text: string, isError = false, isLasting = false): void {
  const notice = element("notice");
  clearTimeout(noting);
  // Screen readers would repeat a text that is written again.
  if (notice.textContent !== text) notice.textContent = text;
  notice.classList.toggle("error", isError);
  if (!isLasting) noting = window.setTimeout(() => (notice.textContent = ""), NOTE_MS);
}

/** Puts a button behind what was said. */
export function offer(text: string, onClick: () => void): void {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.addEventListener("click", onClick);
  element("message").append(" ", button);
}

/** Pixels of the scene that the panel covers: at the left, or on phones at the bottom. */
export function covered(): [number, number] {
  const { right, top, width } = panel.aside.getBoundingClientRect();
  return width > innerWidth * 0.7 ? [0, Math.max(innerHeight - top, 0)] : [right, 0];
}

/** `size`: of the scene without its strays. */
export function showFacts(description: Description, nDrawn: number, stepM: number, size: Vector): void {
  const { cells, metric, n_gaussians } = description;
  const missing = cells.filter((cell) => cell.state === "missing").length;
  const stale = cells.filter((cell) => cell.state === "stale").length;
  document.title = `${description.scene} · SLAG`;
  element("scene").textContent = description.scene;
  element("facts").textContent = [
    nDrawn === 0 ? "opening…" : `${lengthText(size[0], metric)} × ${lengthText(size[1], metric)}`,
    description.views.length > 0 ? `${description.views.length} photos` : "",
    missing > 0 ? `${missing} of ${cells.length} cells missing` : "",
    stale > 0 ? `${stale} of an earlier generation` : "",
  ].filter(Boolean).join(" · ");
  element("amount").textContent = `${count.format(nDrawn)} of ${count.format(n_gaussians)} Gaussians, generation ${description.generation}, grid ${stepM} ${metric ? "m" : "units"}`;
  element("photos-label").hidden = description.views.length === 0;
  element("changes-label").hidden = description.generation < 2;
}

export function showLegend(range: { min: number; max: number } | null, level: number): void {
  element("legend").hidden = range === null;
  if (!range) return;
  const score = (range.min + (level / 255) * (range.max - range.min)).toFixed(2);
  panel.threshold.value = String(level);
  panel.threshold.setAttribute("aria-valuetext", score);
  element("threshold-value").textContent = score;
  paintRamp();
}

/** Paints the scores from the slider on in the theme's colours. */
export function paintRamp(): void {
  const level = Number(panel.threshold.value);
  const context = element<HTMLCanvasElement>("ramp").getContext("2d");
  for (let l = 0; context && l < 256; l++) {
    const [r, g, b] = l >= level ? rampColour((l - level) / Math.max(255 - level, 1), PALETTES[themeNow()].warm) : [120, 126, 133];
    context.fillStyle = `rgb(${r} ${g} ${b})`;
    context.fillRect(l, 0, 1, 1);
  }
}

export function showSecond(text: string | null): void {
  element("second-legend").hidden = text === null;
  element("second-legend").textContent = text ?? "";
}

/** Shows or hides what stands behind "+". */
export function showBeside(isShown: boolean): void {
  panel.beside.hidden = !isShown;
  panel.more.setAttribute("aria-expanded", String(isShown));
  panel.more.textContent = isShown ? "−" : "+";
}

/** Asks for the service's token. */
export function askToken(): Promise<string> {
  const dialog = element<HTMLDialogElement>("token-dialog");
  const input = element<HTMLInputElement>("token");
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(input.value), { once: true }));
}
