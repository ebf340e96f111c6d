// The panel's elements, and what is written in them.

import { rampColour } from "./drawing/ramp";
import type { Answer, Description, Goal, Photo } from "./network";

function element<T extends HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`index.html has no #${id}`);
  return found as T;
}

export const panel = {
  canvas: element<HTMLCanvasElement>("canvas"),
  labels: element("labels"),
  form: element<HTMLFormElement>("ask"),
  question: element<HTMLInputElement>("question"),
  second: element<HTMLInputElement>("second"),
  questionSuggestions: element("question-suggestions"),
  secondSuggestions: element("second-suggestions"),
  blend: element<HTMLImageElement>("blend"),
  threshold: element<HTMLInputElement>("threshold"),
  showBoxes: element<HTMLInputElement>("show-boxes"),
  showGrid: element<HTMLInputElement>("show-grid"),
  showCells: element<HTMLInputElement>("show-cells"),
  showPhotos: element<HTMLInputElement>("show-photos"),
  showChanges: element<HTMLInputElement>("show-changes"),
  changes: element("changes"),
  copyLink: element<HTMLButtonElement>("copy-link"),
  whole: element<HTMLButtonElement>("whole"),
};

const count = new Intl.NumberFormat("en");

export function say(text: string, isError = false): void {
  element("message").textContent = text;
  element("message").classList.toggle("error", isError);
}

export function showFacts(description: Description, nDrawn: number, stepM: number): void {
  const missing = description.cells.filter((cell) => cell.state === "missing").length;
  const stale = description.cells.filter((cell) => cell.state === "stale").length;
  document.title = `${description.scene} · SLAG`;
  element("scene").textContent = description.scene;
  element("facts").textContent = [
    `${count.format(nDrawn)} of ${count.format(description.n_gaussians)} Gaussians`,
    `generation ${description.generation}`,
    missing > 0 ? `${missing} of ${description.cells.length} cells missing` : "",
    stale > 0 ? `${stale} of an earlier generation` : "",
    `grid ${stepM} ${description.metric ? "m" : "units"}`,
  ].filter(Boolean).join(" · ");
  element("photos-label").hidden = description.views.length === 0;
  element("changes-label").hidden = description.generation < 2;
}

export function showLegend(range: { min: number; max: number } | null, level: number): void {
  element("legend").hidden = range === null;
  if (!range) return;
  const score = (l: number) => (range.min + (l / 255) * (range.max - range.min)).toFixed(2);
  panel.threshold.value = String(level);
  panel.threshold.setAttribute("aria-valuetext", score(level));
  element("threshold-value").textContent = score(level);
  element("lowest").textContent = score(0);
  element("highest").textContent = score(255);
  const context = element<HTMLCanvasElement>("ramp").getContext("2d");
  for (let l = 0; context && l < 256; l++) {
    const [r, g, b] = l >= level ? rampColour((l - level) / Math.max(255 - level, 1)) : [120, 126, 133];
    context.fillStyle = `rgb(${r} ${g} ${b})`;
    context.fillRect(l, 0, 1, 1);
  }
}

export function showSecond(text: string | null): void {
  element("second-legend").hidden = text === null;
  element("second-legend").textContent = text ?? "";
}

export function showAnswers(name: string, answers: Answer[], chosen: number | null, onChoose: (index: number) => void): void {
  const focused = document.activeElement?.closest("#answers li");
  const focusedIndex = focused ? [...element("answers").children].indexOf(focused) : -1;
  element("answers").replaceChildren(...answers.map((answer, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("aria-pressed", String(index === chosen));
    const title = document.createElement("span");
    title.textContent = `${index + 1}. ${name}`;
    const score = document.createElement("span");
    score.className = "score";
    score.textContent = answer.score.toFixed(2);
    const place = document.createElement("small");
    const gaussians = answer.n_gaussians === undefined ? "" : ` · ${count.format(answer.n_gaussians)} Gaussians`;
    place.textContent = `${answer.position_in_world.map((v) => v.toFixed(2)).join(", ")} m${gaussians}`;
    button.append(title, score, place);
    button.addEventListener("click", () => onChoose(index));
    const item = document.createElement("li");
    item.append(button);
    return item;
  }));
  if (focusedIndex >= 0) element("answers").children[focusedIndex]?.querySelector("button")?.focus();
}

export function showDetails(name: string, answer: Answer | null, isGeographic: boolean): void {
  const section = element("details");
  section.hidden = answer === null;
  if (!answer) return;
  const metres = (v: number[]) => `${v.map((x) => x.toFixed(2)).join(", ")} m`;
  const size = answer.oriented_box?.size ?? answer.box_max_in_world.map((v, i) => v - answer.box_min_in_world[i]);
  const rows: [string, string][] = [
    [isGeographic ? "East, north, up" : "World", metres(answer.position_in_world)],
    ["Size", metres(size)],
    ["Score", answer.score.toFixed(3)],
  ];
  if (answer.geographic) {
    const { latitude_deg, longitude_deg, height_m } = answer.geographic;
    rows.push(["Lat, lon", `${latitude_deg.toFixed(7)}, ${longitude_deg.toFixed(7)}`], ["Height", `${height_m.toFixed(2)} m`]);
  }
  if (answer.degree !== undefined) rows.push(["Relation", `holds to ${answer.degree.toFixed(2)}`]);
  for (const other of answer.related_to ?? []) rows.push([`To: ${other.thing}`, metres(other.position_in_world)]);
  if (answer.evidence) rows.push(["Best photo", answer.evidence.photo]);
  if (answer.id) rows.push(["Id", answer.id]);
  const heading = document.createElement("h2");
  heading.textContent = name;
  const list = document.createElement("dl");
  for (const [term, text] of rows) {
    const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
    dt.textContent = term;
    dd.textContent = text;
    list.append(dt, dd);
  }
  section.replaceChildren(heading, list);
}

/** Lists places to stand in the details, or says why there is none. */
export function showPlaces(goals: Goal[], none: string | null, chosen: number | null, onChoose: (index: number) => void): void {
  const places = document.createElement("div");
  places.id = "places";
  const heading = document.createElement("h3");
  heading.textContent = "Places to stand";
  places.append(heading);
  const list = document.createElement("ol");
  list.append(...goals.map((goal, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("aria-pressed", String(index === chosen));
    const [x, y] = goal.position_in_world.map((v) => v.toFixed(2));
    button.textContent = `${x}, ${y} m · sees ${Math.round(goal.visible_share * 100)} % · clear by ${goal.clearance_m.toFixed(2)} m · way ${goal.path_m.toFixed(1)} m`;
    button.addEventListener("click", () => onChoose(index));
    const item = document.createElement("li");
    item.append(button);
    return item;
  }));
  if (goals.length > 0) places.append(list);
  if (none) {
    const reason = document.createElement("p");
    reason.textContent = none;
    places.append(reason);
  }
  const section = element("details");
  const before = section.querySelector("#places");
  const focused = [...(before?.querySelectorAll("button") ?? [])].indexOf(document.activeElement as HTMLButtonElement);
  if (before) before.replaceWith(places);
  else section.append(places);
  if (focused >= 0) places.querySelectorAll("button")[focused]?.focus();
}

const SVG = "http://www.w3.org/2000/svg";

/**
 * Shows a photo in the details: the picture, where there is one, with a box in it, and a button that goes
 * there.
 */
export function showPhoto(photo: Photo, picture: string | null, boxPx: number[] | null, onGo: () => void, onBlend: (share: number) => void): void {
  const figure = document.createElement("figure");
  if (picture) {
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", `Photo ${photo.name}`);
    const image = document.createElementNS(SVG, "image");
    const put = (to: Element, values: Record<string, number | string>) => Object.entries(values).forEach(([name, value]) => to.setAttribute(name, String(value)));
    put(image, { href: picture, width: photo.width_px, height: photo.height_px });
    svg.append(image);
    if (boxPx) {
      const box = document.createElementNS(SVG, "rect");
      put(box, { x: boxPx[0], y: boxPx[1], width: boxPx[2] - boxPx[0], height: boxPx[3] - boxPx[1] });
      svg.append(box);
    }
    figure.append(svg);
  }
  const caption = document.createElement("figcaption");
  const name = document.createElement("span");
  name.textContent = photo.name;
  const go = document.createElement("button");
  go.type = "button";
  go.textContent = "Stand here";
  go.addEventListener("click", onGo);
  caption.append(name, go);
  if (picture) {
    const blend = document.createElement("input");
    Object.assign(blend, { type: "range", min: "0", max: "100", value: "0", id: "blend-share" });
    blend.setAttribute("aria-label", "Photo over the scene");
    blend.addEventListener("input", () => onBlend(Number(blend.value) / 100));
    caption.append(blend);
  }
  figure.append(caption);
  const section = element("details");
  section.querySelector("figure")?.remove();
  section.hidden = false;
  section.append(figure);
}

/** Asks for the service's token. */
export function askToken(): Promise<string> {
  const dialog = element<HTMLDialogElement>("token-dialog");
  const input = element<HTMLInputElement>("token");
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(input.value), { once: true }));
}
