// The encode at work that the page watches: how far it is, its views on a map, the last masks, and the time so far.

import { fetchWork, fetchWorkPicture, type Work } from "./network";

const LOOK_EVERY_MS = 1500;
const SVG = "http://www.w3.org/2000/svg";
const MAP_PX = 296;

const seconds = (value: number) => `${value.toFixed(1)} s`;

function make<K extends keyof HTMLElementTagNameMap>(name: K, text = ""): HTMLElementTagNameMap[K] {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

/** Cells and cameras from above: x to the right, y up. */
function mapOf(work: Work): SVGSVGElement {
  const svg = document.createElementNS(SVG, "svg");
  const corners = [...work.cells.flatMap(({ min, max }) => [min, max]), ...work.views.map((view) => view.position_m)];
  const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => corners.reduce((found, corner) => pick(found, corner[k]), corners[0]?.[k] ?? 0)));
  const scale = (MAP_PX - 12) / Math.max(high[0] - low[0], high[1] - low[1], 1e-6);
  const heightPx = (high[1] - low[1]) * scale + 12;
  const at = (point: number[]) => [6 + (point[0] - low[0]) * scale, heightPx - 6 - (point[1] - low[1]) * scale];
  const put = (name: string, values: Record<string, number | string>) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(values)) made.setAttribute(key, String(value));
    svg.append(made);
  };
  svg.setAttribute("viewBox", `0 0 ${MAP_PX} ${heightPx.toFixed(1)}`);
  svg.setAttribute("role", "img");
  const count = (state: string) => work.views.filter((view) => view.state === state).length;
  svg.setAttribute("aria-label", `Map: ${count("done")} of ${work.views.length} views done, ${count("left-out")} left out`);
  for (const { min, max } of work.cells) {
    const [[x, bottom], [right, y]] = [at(min), at(max)];
    put("rect", { x, y, width: right - x, height: bottom - y });
  }
  for (const view of work.views) {
    const [cx, cy] = at(view.position_m);
    put("circle", { cx, cy, r: 4, class: view.state });
  }
  return svg;
}

function tableOf(rows: [string, number][]): HTMLDListElement {
  const list = make("dl");
  for (const [name, secs] of rows) list.append(make("dt", name), make("dd", seconds(secs)));
  return list;
}

export class WorkPanel {
  private shown: number[] = [];
  private readonly pictures = make("div");

  /** `onEnd` is called once, when the encode has ended. */
  constructor(private readonly section: HTMLElement, private readonly onEnd: (how: string) => void) {
    this.pictures.className = "pictures";
  }

  /** Looks until the encode has ended. */
  async follow(): Promise<void> {
    for (;;) {
      const work = await fetchWork().catch(() => null);
      if (work) {
        this.show(work);
        await this.showPictures(work).catch(() => {});
        if (work.ended) return this.onEnd(work.ended);
      }
      await new Promise((resolve) => setTimeout(resolve, LOOK_EVERY_MS));
    }
  }

  private show(work: Work): void {
    const { stage, unit, total, done } = work.counted;
    const heading = make("h2", work.ended ?? `At work: ${work.phases.at(-1)?.phase ?? "begins"}`);
    const bar = document.createElement("progress");
    bar.max = Math.max(total, 1);
    bar.value = done;
    bar.setAttribute("aria-label", stage || "Progress");
    const counted = make("p", total > 0 ? `${done} of ${total} ${unit}s · ${seconds(work.secs)}` : seconds(work.secs));
    const left = work.views.filter((view) => view.reason);
    const details = make("details");
    details.open = this.section.querySelector("details")?.open ?? false;
    details.append(make("summary", "Time by stage"), tableOf(work.phases.map(({ phase, secs }) => [phase, secs])));
    if (Object.keys(work.busy_secs).length > 0) details.append(make("p", "Of the views, all threads:"), tableOf(Object.entries(work.busy_secs)));
    this.section.replaceChildren(heading, bar, counted, mapOf(work), ...left.map((view) => make("p", `${view.name} is left out: ${view.reason}`)), this.pictures, details);
    this.section.hidden = false;
  }

  /** Fetches pictures that are not shown yet. */
  private async showPictures({ pictures }: Work): Promise<void> {
    const numbers = pictures.map(([number]) => number);
    if (numbers.join() === this.shown.join()) return;
    this.shown = numbers;
    const figures = await Promise.all(pictures.map(async ([number, view, nMasks]) => {
      const figure = make("figure");
      const image = new Image();
      image.alt = `Masks of ${view}`;
      image.src = URL.createObjectURL(await fetchWorkPicture(number));
      image.addEventListener("load", () => URL.revokeObjectURL(image.src), { once: true });
      figure.append(image, make("figcaption", `${view}: ${nMasks} masks`));
      return figure;
    }));
    this.pictures.replaceChildren(...figures);
  }
}
