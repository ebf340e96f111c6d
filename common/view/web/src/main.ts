// Ties the three modules together: state.ts (what a link holds), network.ts (what is asked), drawing/ (what is seen).

import "./style.css";
import { Drawing } from "./drawing/drawing";
import type { Scores } from "./messages";
import { type Answer, type Description, describe, fetchAnswers, fetchScores, NotFound, parseQuestion, setToken, Unauthorized } from "./network";
import { askToken, panel, say, showAnswers, showDetails, showFacts, showHistory, showLegend } from "./panel";
import { readHistory, readState, remember, writeState } from "./state";
import { Streaming } from "./streaming";

const PAUSE_IN_TYPING_MS = 150;
const LOOK_EVERY_MS = 4000;

const state = readState();
let description: Description;
let drawing: Drawing;
let streaming: Streaming;
let scores: Scores | null = null;
let answers: Answer[] = [];
/** What the answers are. */
let thing = "";
let asking = new AbortController();
let typing = 0;

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
  drawing.cells.colour(scores, level);
  showLegend(scores, level);
  drawing.redraw();
}

function choose(index: number | null): void {
  showAnswers(thing, answers, index, choose);
  drawing.showAnswers(thing, answers, index);
  showDetails(thing, index === null ? null : answers[index], description.geographic);
  if (index !== null) drawing.flyToAnswer(answers[index]);
}

async function ask(line: string): Promise<void> {
  asking.abort();
  asking = new AbortController();
  const { signal } = asking;
  state.question = line.trim();
  writeState(state);
  const question = parseQuestion(line);
  if (!question.text) {
    scores = null;
    answers = [];
    colour(0);
    choose(null);
    say("");
    return;
  }
  try {
    const [ofText, reply] = await Promise.all([fetchScores(question, signal), fetchAnswers(question, signal)]);
    // The scores of "mug on the table" are those of mugs.
    const found = reply.thing === question.text ? ofText : await fetchScores({ ...question, text: reply.thing }, signal);
    if (signal.aborted) return;
    scores = found;
    thing = reply.thing;
    answers = reply.answers;
    colour(levelOf(state.threshold ?? reply.threshold ?? found.min + 0.6 * (found.max - found.min), found));
    choose(null);
    say(answers.length > 0 ? `${answers.length} found` : (reply.none ?? "Nothing found"));
    remember(state.question);
    showHistory(readHistory());
    document.documentElement.dataset.answered = state.question;
  } catch (error) {
    if (!signal.aborted) report(error);
  }
}

function report(error: unknown): void {
  if (error instanceof Unauthorized) {
    void withToken(describe).then(() => ask(state.question));
    return;
  }
  say(error instanceof Error ? error.message : String(error), true);
}

function open(): void {
  drawing = new Drawing(panel.canvas, panel.labels, description);
  if (state.camera) drawing.placeAt(state.camera);
  drawing.showRobot(description.position);
  stream();
  if (state.question) {
    panel.question.value = state.question;
    void ask(state.question);
  }
}

function stream(): void {
  streaming = new Streaming(description, drawing, () => {
    document.documentElement.dataset.firstPictureMs ??= performance.now().toFixed(0);
    if (streaming.isComplete) document.documentElement.dataset.complete = "";
    document.documentElement.dataset.gaussians = String(drawing.cells.nGaussians);
    showFacts(description, drawing.cells.nGaussians, drawing.stepM);
  }, report);
  showFacts(description, 0, drawing.stepM);
  streaming.update();
}

const cellsOf = (seen: Description) => JSON.stringify(seen.cells.map(({ cell, state, n_gaussians }) => [cell, state, n_gaussians]));

/** Looks what has changed: generation, cells, the robot's place, or that the service is gone. */
async function look(): Promise<void> {
  try {
    const seen = await describe();
    const isOtherGeneration = seen.generation !== description.generation || seen.scene !== description.scene;
    const isOther = isOtherGeneration || cellsOf(seen) !== cellsOf(description);
    const wasOffline = document.documentElement.dataset.offline !== undefined;
    delete document.documentElement.dataset.offline;
    description = seen;
    drawing.showRobot(seen.position);
    if (isOther) {
      streaming.stop();
      drawing.cells.clear();
      drawing.marks.showCells(seen.cells);
      stream();
      if (state.question) await ask(state.question);
      say(isOtherGeneration ? `The service has generation ${seen.generation} now.` : "Other cells are on board now.");
    } else {
      streaming.update();
      if (wasOffline) say("The service is back.");
    }
  } catch (error) {
    document.documentElement.dataset.offline = "";
    report(error);
  }
  state.camera = drawing.pose();
  writeState(state);
  setTimeout(() => void look(), LOOK_EVERY_MS);
}

function listen(): void {
  panel.form.addEventListener("submit", (event) => {
    event.preventDefault();
    clearTimeout(typing);
    void ask(panel.question.value);
  });
  panel.question.addEventListener("input", () => {
    clearTimeout(typing);
    typing = window.setTimeout(() => void ask(panel.question.value), PAUSE_IN_TYPING_MS);
  });
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
  panel.copyLink.addEventListener("click", () => {
    state.camera = drawing.pose();
    writeState(state);
    // Browsers give pages a clipboard over HTTPS and on this machine only.
    const copied = navigator.clipboard?.writeText(location.href) ?? Promise.reject(new Error("no clipboard"));
    copied.then(() => say("The link is copied."), () => say("The browser does not let this page copy; take the link from the address bar."));
  });
  panel.whole.addEventListener("click", () => drawing.showWhole());
  panel.canvas.addEventListener("click", (event) => {
    const index = drawing.answerAt(event.offsetX, event.offsetY);
    if (index !== null) choose(index);
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
  showHistory(readHistory());
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
  setTimeout(() => void look(), LOOK_EVERY_MS);
}

void start();
