// Answers as cards; the chosen one opens in place: its photo, its position to copy, places to stand.

import { copies, metres, sizeText, strengthOf, whereabouts, type Viewpoint } from "./answers";
import { type Answer, type Description, type Goal, type Photo, isObject } from "./network";
import { panel } from "./panel";
import { crop, photoWithBox, thumbnail } from "./photos";

/** What all cards of one question share. */
export interface Asked {
  /** What the answers are. */
  thing: string;
  /** The question as parameters of an address; empty if none was asked. */
  query: string;
  threshold: number | null;
  viewpoint: Viewpoint;
  description: Description;
}

function make<K extends keyof HTMLElementTagNameMap>(tag: K, text = "", className = ""): HTMLElementTagNameMap[K] {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function button(text: string, onClick: () => void): HTMLButtonElement {
  const made = make("button", text);
  made.type = "button";
  made.addEventListener("click", onClick);
  return made;
}

/** The photo that shows an answer best, by its index in the description. */
export function photoOf(answer: Answer, { views }: Description): number {
  return views.findIndex(({ name }) => name === answer.evidence?.photo);
}

/** A picture of an answer: cut from its best photo, or the small one that the scene carries; null without either. */
function pictureOf(answer: Answer, description: Description): Promise<Element> | null {
  const photo = photoOf(answer, description);
  const view = description.views[photo];
  if (view?.has_picture && answer.evidence) return crop(photo, view, answer.evidence.box_px);
  return answer.id && answer.evidence?.has_thumbnail ? thumbnail(answer.id) : null;
}

export function showCards(answers: Answer[], asked: Asked, onChoose: (index: number) => void): void {
  panel.aside.append(panel.details);
  panel.answers.replaceChildren(...answers.map((answer, index) => {
    const card = button("", () => onChoose(index));
    card.className = "card";
    card.setAttribute("aria-expanded", "false");
    const frame = make("span", "", "frame");
    frame.append(make("span", String(index + 1), "number"));
    const text = make("span");
    const { metric } = asked.description;
    text.append(make("b", asked.thing), make("small", whereabouts(answer.position_in_world, asked.viewpoint, metric), "where"), make("small", sizeText(answer, metric)));
    card.append(frame, text);
    // An object that was clicked has no score.
    if (asked.query) {
      const strength = strengthOf(answer, asked.threshold);
      card.append(make("span", strength, `strength ${strength}`));
    }
    const item = make("li");
    item.append(card);
    pictureOf(answer, asked.description)?.then((picture) => frame.prepend(picture), () => {});
    return item;
  }));
}

/** Says again where the answers are: the viewpoint is another. */
export function placeCards(answers: Answer[], { viewpoint, description }: Asked): void {
  panel.answers.querySelectorAll(".where").forEach((where, index) => {
    if (answers[index]) where.textContent = whereabouts(answers[index].position_in_world, viewpoint, description.metric);
  });
}

/** Opens a card, or none. `place`: where it is best to stand, as far as that is known by then. */
export function openCard(answers: Answer[], chosen: number | null, asked: Asked, place: () => Goal | null): void {
  [...panel.answers.children].forEach((item, index) => {
    item.classList.toggle("chosen", index === chosen);
    item.querySelector(".card")?.setAttribute("aria-expanded", String(index === chosen));
  });
  const answer = chosen === null ? null : answers[chosen];
  panel.details.hidden = !answer;
  panel.details.replaceChildren();
  if (!answer || chosen === null) return void panel.aside.append(panel.details);
  const item = panel.answers.children[chosen];
  item.append(panel.details);
  panel.details.append(facts(answer, asked), copying(() => copies(answer, asked.query, place())));
  showChosen();
}

/** Scrolls to the chosen card, which grows as its photo arrives. */
function showChosen(): void {
  panel.details.closest("li")?.scrollIntoView({ block: "nearest" });
}

function facts(answer: Answer, { description, query, threshold }: Asked): HTMLDListElement {
  const rows: [string, string][] = [[description.geographic ? "East, north, up" : "Position", metres(answer.position_in_world)]];
  if (answer.geographic) {
    const { latitude_deg, longitude_deg, height_m } = answer.geographic;
    rows.push(["Lat, lon", `${latitude_deg.toFixed(7)}, ${longitude_deg.toFixed(7)}`], ["Height", `${height_m.toFixed(2)} m`]);
  }
  if (query) rows.push(["Score", `${answer.score.toFixed(2)}${threshold === null ? "" : `, found from ${threshold.toFixed(2)}`}`]);
  if (answer.names?.length) rows.push(["Names", answer.names.map(({ name, confidence }) => `${name} ${Math.round(confidence * 100)} %`).join(", ")]);
  if (!isObject(answer)) rows.push(["Kind", "a group of points, not a marked object"]);
  if (answer.degree !== undefined) rows.push(["Relation", `holds to ${answer.degree.toFixed(2)}`]);
  for (const other of answer.related_to ?? []) rows.push([`To: ${other.thing}`, metres(other.position_in_world)]);
  if (answer.evidence) rows.push(["Best photo", answer.evidence.photo]);
  if (answer.id) rows.push(["Id", answer.id]);
  const list = make("dl");
  for (const [term, text] of rows) list.append(make("dt", term), make("dd", text));
  return list;
}

/** Buttons that copy; without a clipboard, which browsers give over HTTPS and on this machine only, the text is shown. */
function copying(texts: () => Record<string, string>): HTMLElement {
  const row = make("div", "Copy", "copies");
  const show = (text: string) => {
    row.querySelector("textarea")?.remove();
    const shown = make("textarea", text);
    shown.readOnly = true;
    shown.setAttribute("aria-label", "To copy");
    row.append(shown);
    shown.select();
  };
  for (const name of Object.keys(texts())) {
    const copy = button(name, () => {
      const text = texts()[name];
      (navigator.clipboard?.writeText(text) ?? Promise.reject(new Error("no clipboard"))).then(() => {
        copy.textContent = "Copied";
        setTimeout(() => (copy.textContent = name), 1500);
      }, () => show(text));
    });
    row.append(copy);
  }
  return row;
}

/** Shows a photo first of the details, with a box, a button that goes there, and a slider that lays it over the scene. */
export async function showPhoto(photo: Photo, picture: Promise<string> | null, boxPx: number[] | null, onGo: () => void, onBlend: (share: number) => void): Promise<void> {
  const figure = make("figure");
  const caption = make("figcaption");
  caption.append(make("span", photo.name), button("Stand here", onGo));
  figure.append(caption);
  panel.details.querySelector("figure")?.remove();
  panel.details.hidden = false;
  panel.details.prepend(figure);
  if (!picture) return;
  const url = await picture;
  panel.blend.src = url;
  figure.prepend(photoWithBox(url, photo, boxPx));
  const blend = make("input");
  Object.assign(blend, { type: "range", min: "0", max: "100", value: "0", id: "blend-share" });
  blend.addEventListener("input", () => onBlend(Number(blend.value) / 100));
  const label = make("label", "Photo over the scene");
  label.append(blend);
  caption.append(label);
  showChosen();
}

/** Lists places to stand in the details, or says why there is none. */
export function showPlaces(goals: Goal[], none: string | null, chosen: number | null, onChoose: (index: number) => void): void {
  const places = make("div");
  places.id = "places";
  places.append(make("h3", "Places to stand"));
  const list = make("ol");
  list.append(...goals.map((goal, index) => {
    const [x, y] = goal.position_in_world.map((v) => v.toFixed(2));
    const place = button(`${x}, ${y} m · sees ${Math.round(goal.visible_share * 100)} % · clear by ${goal.clearance_m.toFixed(2)} m · way ${goal.path_m.toFixed(1)} m`, () => onChoose(index));
    place.setAttribute("aria-pressed", String(index === chosen));
    const item = make("li");
    item.append(place);
    return item;
  }));
  if (goals.length > 0) places.append(list);
  if (none) places.append(make("p", none));
  const before = panel.details.querySelector("#places");
  const focused = [...(before?.querySelectorAll("button") ?? [])].indexOf(document.activeElement as HTMLButtonElement);
  if (before) before.replaceWith(places);
  else panel.details.append(places);
  if (focused >= 0) places.querySelectorAll("button")[focused]?.focus();
}
