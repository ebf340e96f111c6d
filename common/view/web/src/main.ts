// Ties the three modules together: state.ts (what a link holds), network.ts (what is asked), drawing/ (what is
// seen).

import "./style.css";
import { ChangesPanel } from "./changes";
import { Drawing } from "./drawing/drawing";
import type { Scores } from "./messages";
import { type Answer, type Answers, type Description, describe, fetchAnswers, fetchPhoto, fetchScores, fetchWords, follow, NotFound, parseQuestion, setToken, Unauthorized, type Word } from "./network";
import { askToken, panel, say, showAnswers, showDetails, showFacts, showLegend, showPhoto, showSecond } from "./panel";
import { PlacesToStand } from "./places";
import { readHistory, readState, remember, writeState } from "./state";
import { Streaming } from "./streaming";
import { Combobox, suggest } from "./suggestions";

const PAUSE_IN_TYPING_MS = 150;
const LOOK_EVERY_MS = 4000;
/** Where things were found, Gaussians are lit from this share of the range of scores, or a lower threshold. */
const SHARE_OF_RANGE = 0.75;

const state = readState();
let description: Description;
let drawing: Drawing;
let streaming: Streaming;
let places: PlacesToStand;
let changes: ChangesPanel;
let scores: Scores | null = null;
/** Of the second question, and its level of threshold. */
let second: { scores: Scores; threshold: number } | null = null;
let answers: Answer[] = [];
/** What the answers are. */
let thing = "";
let asking = new AbortController();
let typing = 0;
let looking = 0;
let photoOpened = 0;
/** Of the generation that is drawn, and whether they are all. */
let words: Word[] = [];
let hasAllWords = false;
const comboboxes: Combobox[] = [];

const levelOf = (score: number, range: Scores) => Math.min(255, Math.max(1, Math.round(((score - range.min) / (range.max - range.min || 1)) * 255)));

/** Runs a request again after the token was given. */
async function withToken<T>(request: () => Promise<T>): Promise<T> {
  for (;;) {
    try {
      return await request();
    } catch (error) {
      if (!(error instanceof Unauthorized)) throw error;
      setToken(await askToken());
    }
  }
}

function colour(level: number): void {
  drawing.cells.colour(scores && { scores, threshold: level }, second);
  showLegend(scores, level);
  drawing.redraw();
}

function choose(index: number | null): void {
  showAnswers(thing, answers, index, choose);
  drawing.showAnswers(thing, answers, index);
  const answer = index === null ? null : answers[index];
  showDetails(thing, answer, description.geographic);
  void places.ask(answer, description);
  if (!answer) return;
  drawing.flyToAnswer(answer);
  const photo = description.views.findIndex(({ name }) => name === answer.evidence?.photo);
  if (photo >= 0) void openPhoto(photo, answer.evidence?.box_px ?? null);
}

/** Shows a photo with a box in it. */
async function openPhoto(index: number, boxPx: number[] | null): Promise<void> {
  const photo = description.views[index];
  const opened = ++photoOpened;
  try {
    const picture = photo.has_picture ? URL.createObjectURL(await fetchPhoto(index)) : null;
    if (opened !== photoOpened) return;
    leavePhoto();
    if (picture) panel.blend.src = picture;
    showPhoto(photo, picture, boxPx, () => drawing.standAt(photo), (share) => {
      drawing.standAt(photo);
      panel.blend.hidden = share === 0;
      // Opacity as a property: the page's policy allows no style attributes in HTML.
      panel.blend.style.opacity = String(share);
    });
  } catch (error) {
    report(error);
  }
}

function leavePhoto(): void {
  panel.blend.hidden = true;
  const share = document.querySelector<HTMLInputElement>("#blend-share");
  if (share) share.value = "0";
}

/** Asks one line of words; nothing for an empty one. */
async function fetchBoth(line: string, signal: AbortSignal): Promise<[Scores, Answers] | null> {
  const question = parseQuestion(line);
  if (!question.text) return null;
  const [ofText, reply] = await Promise.all([fetchScores(question, signal), fetchAnswers(question, signal)]);
  // The scores of "mug on the table" are those of mugs.
  return [reply.thing === question.text ? ofText : await fetchScores({ ...question, text: reply.thing }, signal), reply];
}

/** A thing's Gaussians at edges and in shade score below the average of its masks, by which it is found. */
function levelFrom(found: Scores, { threshold, answers }: Pick<Answers, "threshold" | "answers">): number {
  const high = found.min + SHARE_OF_RANGE * (found.max - found.min);
  return levelOf(answers.length > 0 ? Math.min(threshold ?? high, high) : (threshold ?? high), found);
}

async function ask(): Promise<void> {
  const start = performance.now();
  asking.abort();
  asking = new AbortController();
  const { signal } = asking;
  writeState(state);
  try {
    const [first, beside] = await Promise.all([fetchBoth(state.question, signal), fetchBoth(state.second, signal)]);
    if (signal.aborted) return;
    // Scores of another generation would light the wrong Gaussians; the next poll brings both.
    if ([first, beside].some((found) => found && found[0].generation !== description.generation % 2 ** 32)) return void lookSoon();
    scores = first?.[0] ?? null;
    thing = first?.[1].thing ?? "";
    answers = first?.[1].answers ?? [];
    second = beside && { scores: beside[0], threshold: levelFrom(beside[0], beside[1]) };
    showSecond(beside && `${beside[1].thing}: ${beside[1].answers.length} found`);
    if (first && state.threshold !== null) colour(levelOf(state.threshold, first[0]));
    else colour(first ? levelFrom(...first) : 0);
    choose(null);
    drawing.onceDrawn(() => performance.measure("answered", { start }));
    say(first ? (answers.length > 0 ? `${answers.length} found` : (first[1].none ?? "Nothing found")) : "");
    if (first) remember(state.question);
    document.documentElement.dataset.answered = [state.question, state.second].filter(Boolean).join(" | ");
  } catch (error) {
    if (!signal.aborted) report(error);
  }
}

function report(error: unknown): void {
  if (error instanceof Unauthorized) {
    void withToken(describe).then(ask);
    return;
  }
  say(error instanceof Error ? error.message : String(error), true);
}

function open(): void {
  drawing = new Drawing(panel.canvas, panel.labels, description, leavePhoto, (share) => streaming.isComplete && streaming.lower(share));
  places = new PlacesToStand(drawing);
  changes = new ChangesPanel(drawing, panel.changes);
  panel.form.hidden = !description.can_ask;
  if (state.camera) drawing.placeAt(state.camera);
  drawing.showRobot(description);
  stream();
  panel.question.value = state.question;
  panel.second.value = state.second;
  if (description.can_ask && (state.question || state.second)) void ask();
}

/** Learns which words find something; without them, only the history is suggested. */
async function learnWords(): Promise<void> {
  const learnt = description.can_ask ? await fetchWords().catch(() => null) : null;
  words = learnt?.words ?? [];
  // Models that take any text count a few words a request.
  hasAllWords = learnt?.complete ?? true;
  for (const combobox of comboboxes) combobox.refresh();
}

function stream(): void {
  void learnWords();
  streaming = new Streaming(description, drawing, () => {
    document.documentElement.dataset.firstPictureMs ??= performance.now().toFixed(0);
    if (streaming.isWhole) document.documentElement.dataset.wholePictureMs ??= performance.now().toFixed(0);
    document.documentElement.toggleAttribute("data-complete", streaming.isComplete);
    document.documentElement.dataset.gaussians = String(drawing.cells.nDrawn);
    showFacts(description, drawing.cells.nDrawn, drawing.stepM);
  }, report);
  showFacts(description, 0, drawing.stepM);
  streaming.update();
}

const cellsOf = (seen: Description) => JSON.stringify(seen.cells.map(({ cell, state, generation, n_gaussians }) => [cell, state, generation, n_gaussians]));

/** Polls the service for its generation, cells and the robot's place, and notices when it is gone. */
async function look(): Promise<void> {
  try {
    const seen = await describe();
    const isOtherGeneration = seen.generation !== description.generation || seen.scene !== description.scene;
    const isOther = isOtherGeneration || cellsOf(seen) !== cellsOf(description);
    const wasOffline = document.documentElement.dataset.offline !== undefined;
    delete document.documentElement.dataset.offline;
    description = seen;
    drawing.showRobot(seen);
    if (isOther) {
      streaming.stop();
      drawing.cells.clear();
      drawing.marks.showCells(seen.cells);
      stream();
      if (panel.showChanges.checked) void changes.show();
      if (description.can_ask && (state.question || state.second)) await ask();
      say(isOtherGeneration ? `The service has generation ${seen.generation} now.` : "Other cells are on board now.");
    } else {
      streaming.update();
      if (!hasAllWords) void learnWords();
      if (wasOffline) say("The service is back.");
    }
  } catch (error) {
    document.documentElement.dataset.offline = "";
    report(error);
  }
  state.camera = drawing.pose();
  writeState(state);
  lookSoon(LOOK_EVERY_MS);
}

/** Schedules one poll. */
function lookSoon(afterMs = 0): void {
  clearTimeout(looking);
  looking = window.setTimeout(() => void look(), afterMs);
}

/** Listens to a robot's events; without them the next poll finds changes. */
async function hearEvents(): Promise<void> {
  try {
    await follow((name, data) => {
      if (name === "generation" && (data as { generation?: number } | null)?.generation !== description.generation) lookSoon();
      if (name === "following") lookSoon();
    });
  } catch {
    // The page polls every few seconds anyway.
  }
  setTimeout(() => void hearEvents(), 5 * LOOK_EVERY_MS);
}

function listen(): void {
  const read = () => {
    clearTimeout(typing);
    if (panel.question.value.trim() !== state.question) state.threshold = null;
    [state.question, state.second] = [panel.question.value.trim(), panel.second.value.trim()];
    void ask();
  };
  panel.form.addEventListener("submit", (event) => {
    event.preventDefault();
    read();
  });
  for (const [box, list] of [[panel.question, panel.questionSuggestions], [panel.second, panel.secondSuggestions]] as const) {
    comboboxes.push(new Combobox(box, list, (line) => suggest(line, readHistory(), words), read));
    box.addEventListener("input", () => {
      clearTimeout(typing);
      typing = window.setTimeout(read, PAUSE_IN_TYPING_MS);
    });
  }
  panel.threshold.addEventListener("input", () => {
    if (!scores) return;
    const level = Number(panel.threshold.value);
    state.threshold = scores.min + (level / 255) * (scores.max - scores.min);
    colour(level);
    writeState(state);
  });
  const toggle = (box: HTMLInputElement, group: () => { visible: boolean }) => box.addEventListener("change", () => {
    group().visible = box.checked;
    drawing.redraw();
  });
  toggle(panel.showBoxes, () => drawing.marks.boxes);
  toggle(panel.showGrid, () => drawing.marks.ground);
  toggle(panel.showCells, () => drawing.marks.cells);
  toggle(panel.showPhotos, () => drawing.marks.photos);
  panel.showChanges.addEventListener("change", () => (panel.showChanges.checked ? void changes.show() : changes.hide()));
  panel.copyLink.addEventListener("click", () => {
    state.camera = drawing.pose();
    writeState(state);
    // Browsers give pages a clipboard over HTTPS and on this machine only.
    const copied = navigator.clipboard?.writeText(location.href) ?? Promise.reject(new Error("no clipboard"));
    copied.then(() => say("The link is copied."), () => say("The browser does not let this page copy; take the link from the address bar."));
  });
  panel.whole.addEventListener("click", () => drawing.showWhole());
  panel.canvas.addEventListener("click", (event) => {
    if (places.chooseAt(event.offsetX, event.offsetY)) return;
    const index = drawing.answerAt(event.offsetX, event.offsetY);
    if (index !== null) return choose(index);
    const photo = drawing.photoAt(description.views, event.offsetX, event.offsetY);
    if (photo !== null) void openPhoto(photo, null).then(() => drawing.standAt(description.views[photo]));
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "/" || event.target instanceof HTMLInputElement) return;
    event.preventDefault();
    panel.question.focus();
  });
}

async function start(): Promise<void> {
  if (!document.createElement("canvas").getContext("webgl2")) {
    return say("This browser has no WebGL 2, which drawing the scene needs. Switch on hardware acceleration or take another browser.", true);
  }
  say("Opening…");
  try {
    description = await withToken(describe);
  } catch (error) {
    say(error instanceof NotFound ? "This service has no scene to show (it does not answer /v1/view)." : String((error as Error).message), true);
    setTimeout(() => void start(), LOOK_EVERY_MS);
    return;
  }
  say("");
  open();
  listen();
  lookSoon(LOOK_EVERY_MS);
  if (description.program === "slag-edge") void hearEvents();
}

void start();
