// Questions and what comes of them: the scene lit, the answers' cards and boxes, one of them chosen.

import { OPACITY, strengthOf, type Viewpoint } from "./answers";
import { type Asked, openCard, photoOf, placeCards, showCards, showPhoto } from "./cards";
import { clustersOf, topScore, voxelOf } from "./clusters";
import type { Question } from "./drawing/cells";
import type { Drawing } from "./drawing/drawing";
import type { Scores } from "./messages";
import { type Answer, type Answers, type Asker, type Description, fetchAnswers, fetchScores, isObject, MAX_ANSWERS, Offline, parseQuestion, type Photo } from "./network";
import { offer, panel, say, showLegend, showSecond } from "./panel";
import { pictureOf } from "./photos";
import type { PlacesToStand } from "./places";
import { remember, type State, writeState } from "./state";

/** Where things were found, Gaussians are lit from this share of the range of scores, or a lower threshold. */
const SHARE_OF_RANGE = 0.75;
/** A question that takes longer is said to be under way. */
const SLOW_MS = 400;
/** Objects below this share of the threshold are weak: groups answer in their place where they are surer, as on robots. */
const SURE = 1.15;

function bestLevel({ byCell }: Scores): number {
  let best = 0;
  for (const levels of byCell.values()) for (const level of levels) best = Math.max(best, level);
  return best;
}

const levelOf = (score: number, range: Scores) => Math.min(255, Math.max(1, Math.round(((score - range.min) / (range.max - range.min || 1)) * 255)));

/** Words of a relation or a comparison, which robots understand ("docs/api.md"). */
const RELATION = /(^|\s)(on|under|underneath|beneath|below|above|over|in|inside|within|near|close to|by|at|beside|next to|between|left of|right of|in front of|before|behind|nearest|closest|farthest|furthest|largest|biggest|smallest)\s/i;

interface Found {
  scores: Scores;
  reply: Answers;
}

/** Why nothing was found. */
function noneText({ thing, best, isOfPoints, threshold, none, isBelowThreshold, isPlain }: Answers): string {
  if (isPlain && isBelowThreshold && threshold !== null) {
    // Of points few may reach it, too few for a group.
    const found = best === null ? "" : best < threshold ? `best ${isOfPoints ? "point " : ""}${best.toFixed(2)}, ` : "but for a few points, ";
    return `Nothing here is like “${thing}” (${found}found from ${threshold.toFixed(2)}).`;
  }
  return `Not found. ${(none ?? "").replace(/\d+\.\d{4,}/g, (number) => Number(number).toFixed(3))}`;
}

const countText = ({ answers, hasMore }: Answers) => (hasMore ? `${answers.length}+` : String(answers.length || "not"));
const shortened = (reply: Answers): Answers => ({ ...reply, answers: reply.answers.slice(0, MAX_ANSWERS), hasMore: reply.answers.length > MAX_ANSWERS });

/** A thing's Gaussians at edges and in shade score below the average of its masks, by which it is found. Outside of objects, other things reach that level, too: trees beside a car. */
function levelsFrom({ scores, reply: { threshold, answers } }: Found): { threshold: number; outside: number; answers: Answer[] } {
  const high = scores.min + SHARE_OF_RANGE * (scores.max - scores.min);
  const things = answers.filter(({ id }) => id);
  const found = levelOf(threshold ?? high, scores);
  const outside = answers.some(isObject) ? Infinity : found;
  return { threshold: things.length > 0 ? Math.min(found, levelOf(high, scores)) : found, outside, answers: things };
}

/** As robots judge it: the first answer's score as a share of the threshold. */
const surenessOf = ([first]: Answer[], threshold: number) => (first ? first.score / Math.max(threshold, Number.MIN_VALUE) : -Infinity);

export class Asking {
  private scores: Scores | null = null;
  /** Of the second question, and its level of threshold. */
  private second: Question | null = null;
  private answers: Answer[] = [];
  private asked: Asked | null = null;
  private chosen: number | null = null;
  /** What the questions found last. */
  private found: [Found | null, Found | null] = [null, null];
  private controller = new AbortController();
  private photoOpened = 0;
  /** Whether the service was gone when it was asked last. */
  isCutOff = false;

  /** `viewpoint` is from where distances are said now; `onOther` is called when the service has another generation. */
  constructor(private readonly state: State, private readonly drawing: Drawing, private readonly places: PlacesToStand,
    private readonly description: () => Description, private readonly viewpoint: (ofCamera?: boolean) => Viewpoint, private readonly onOther: () => void, private readonly report: (error: unknown, tell?: (text: string, isError?: boolean) => void) => void) {}

  /** `outside`: the level from which Gaussians outside of the things are lit. */
  colour(level: number, outside = level, answers: Answer[] = []): void {
    this.drawing.cells.colour(this.scores && { scores: this.scores, threshold: level, outside, answers }, this.second);
    showLegend(this.scores, level);
    this.drawing.redraw();
  }

  /** Lights from a level on, as the slider says. */
  light(level: number): void {
    if (!this.scores) return;
    this.state.threshold = this.scores.min + (level / 255) * (this.scores.max - this.scores.min);
    this.colour(level);
    writeState(this.state);
  }

  /** Asks one line of words; nothing for an empty one. */
  private async fetchBoth(line: string, signal: AbortSignal): Promise<Found | null> {
    const question = parseQuestion(line);
    if (!question.text) return null;
    const [ofText, reply] = await Promise.all([fetchScores(question, signal), fetchAnswers(question, signal, this.askers())]);
    // The scores of "mug on the table" are those of mugs.
    const scores = reply.thing === question.text ? ofText : await fetchScores({ ...question, text: reply.thing }, signal);
    // Of groups no service says a photo.
    for (const answer of reply.answers) answer.evidence ??= this.photoBySight(answer);
    const [sureness, isStore] = [surenessOf(reply.answers, reply.threshold ?? 0), this.description().program !== "slag-edge"];
    if (reply.isPlain && reply.threshold !== null && (reply.answers.length === 0 || (isStore && sureness < SURE))) {
      const groups = this.groupsOf(scores, reply.threshold);
      if (surenessOf(groups, reply.threshold) > sureness) reply.answers = groups;
      // A store's page says no best score of things.
      if (reply.best === null) [reply.best, reply.isOfPoints] = [scores.min + (bestLevel(scores) / 255) * (scores.max - scores.min), true];
    }
    return { scores, reply: shortened(reply) };
  }

  private groupsOf(scores: Scores, threshold: number): Answer[] {
    const answers = clustersOf(this.drawing.cells.all(), scores, threshold, voxelOf(this.description()));
    for (const answer of answers) answer.evidence = this.photoBySight(answer);
    return answers;
  }

  /** The robot, or where none is known to look anywhere the one who looks at the page. */
  private askers(): Asker[] {
    return [this.viewpoint(), this.viewpoint(true)];
  }

  /** Shows what is most like the question, though less than what counts as found. */
  private showNearest({ scores, reply }: Found): void {
    const threshold = topScore(this.drawing.cells.all(), scores);
    if (threshold === null) return;
    this.show({ scores, reply: shortened({ ...reply, answers: this.groupsOf(scores, threshold), isNearest: true }) }, null);
    this.light(levelOf(threshold, scores));
  }

  /** Says distances from where the camera, or the robot, is now. */
  moved(): void {
    if (!this.asked) return;
    this.asked.viewpoint = this.viewpoint();
    placeCards(this.answers, this.asked);
  }

  /** A photo that sees a group, the one that shows it largest. */
  private photoBySight(answer: Answer): Answer["evidence"] {
    return this.drawing.photoOf(answer, this.description().views) ?? undefined;
  }

  async ask(): Promise<void> {
    const { state } = this;
    const start = performance.now();
    this.controller.abort();
    this.controller = new AbortController();
    const { signal } = this.controller;
    this.isCutOff = false;
    writeState(state);
    // The answers of the question before are not this one's.
    const slow = setTimeout(() => {
      if (signal.aborted) return;
      say("Looking…");
      panel.answers.setAttribute("aria-busy", "true");
    }, SLOW_MS);
    const [first, beside] = await Promise.allSettled([state.question, state.second].map((line) => this.fetchBoth(line, signal)));
    clearTimeout(slow);
    if (signal.aborted) return;
    panel.answers.setAttribute("aria-busy", "false");
    const found = [first, beside].map((asked) => (asked.status === "fulfilled" ? asked.value : null));
    // Scores of another generation would light the wrong Gaussians; the next poll brings both.
    if (found.some((one) => one && one.scores.generation !== this.description().generation % 2 ** 32)) return this.onOther();
    this.show(found[0], found[1]);
    this.drawing.onceDrawn(() => performance.measure("answered", { start }));
    if (found[0]) remember(state.question);
    if (first.status === "rejected") this.fail(first.reason, (text, isError) => this.sayRefused(text, isError));
    else if (beside.status === "rejected") this.fail(beside.reason, showSecond);
    else document.documentElement.dataset.answered = [state.question, state.second].filter(Boolean).join(" | ");
  }

  /** Says why nothing was answered; the words that the service names in place of an unknown one are buttons. */
  private sayRefused(text: string, isError?: boolean): void {
    const [, start, unknown, near] = text.match(/^(.*"(.+)" is not one of .*did you mean) (.+)\?$/) ?? [];
    say(start ?? text, isError);
    for (const word of near?.split(", ") ?? []) {
      offer(word, () => {
        panel.question.value = this.state.question.replace(unknown, word);
        panel.form.requestSubmit();
      });
    }
  }

  private fail(error: unknown, tell: (text: string, isError?: boolean) => void): void {
    this.isCutOff = error instanceof Offline;
    this.report(error, this.isCutOff ? undefined : tell);
  }

  /** Lights only what was found: nothing is lit beside the words "not found". */
  private show(first: Found | null, beside: Found | null): void {
    this.found = [first, beside];
    const lit = (found: Found | null) => (found && found.reply.answers.length > 0 ? found : null);
    this.scores = lit(first)?.scores ?? null;
    const second = lit(beside);
    this.second = second && { scores: second.scores, ...levelsFrom(second) };
    showSecond(beside && `${beside.reply.thing}: ${countText(beside.reply)} found`);
    this.drawing.showSecond(beside?.reply.thing ?? "", beside?.reply.answers ?? []);
    const { threshold } = this.state;
    const levels = first && levelsFrom(first);
    if (!first || !levels || !this.scores) this.colour(0);
    else if (threshold === null) this.colour(levels.threshold, levels.outside, levels.answers);
    else this.colour(levelOf(threshold, first.scores));
    this.answers = first?.reply.answers ?? [];
    this.asked = first && { thing: first.reply.thing, query: first.reply.query, threshold: first.reply.threshold, viewpoint: this.viewpoint(), description: this.description() };
    if (this.asked) showCards(this.answers, this.asked, (index) => this.choose(index === this.chosen ? null : index));
    else panel.answers.replaceChildren();
    this.choose(null);
    if (!first) return say("");
    const n = this.answers.length;
    const isGroups = n > 0 && this.answers.every(({ id }) => !id);
    const { reply } = first;
    const groups = n === 1 ? "1 place matches, which is not marked as an object." : `${countText(reply)} places match, none marked as an object.`;
    const isUnlike = n === 0 && reply.isPlain && reply.isBelowThreshold;
    const found = n === 0 ? noneText(reply) : reply.isNearest ? `The nearest to “${reply.thing}”, all below ${reply.threshold?.toFixed(2)}` : isGroups ? groups : `${countText(reply)} found`;
    const askedAs = Object.entries(first.reply.askedAs).map(([word, asked]) => `${word}: asked as ${asked}`);
    const seenFrom = reply.seenFrom ? `seen from ${reply.seenFrom}` : "";
    const isRelation = this.description().program !== "slag-edge" && RELATION.test(parseQuestion(this.state.question).text);
    const notUnderstood = isRelation ? "Robots answer relations; this page looks for the words as they are." : "";
    say([...askedAs, found, seenFrom, notUnderstood].filter(Boolean).join(" · ").replaceAll(". · ", ". "));
    if (isUnlike) offer("Show the nearest anyway", () => this.showNearest(first));
  }

  choose(index: number | null): void {
    const { asked } = this;
    // The answers come back after an object that was clicked, not asked for.
    if (index === null && asked?.query === "") return this.show(...this.found);
    this.chosen = index !== null && index < this.answers.length ? index : null;
    const opacities = this.answers.map((answer) => OPACITY[strengthOf(answer, asked?.threshold ?? null)]);
    this.drawing.showAnswers(asked?.thing ?? "", this.answers, opacities, this.chosen);
    const answer = this.chosen === null ? null : this.answers[this.chosen];
    this.leavePhoto();
    this.photoOpened++;
    if (asked) openCard(this.answers, this.chosen, asked, () => this.places.best);
    else panel.details.hidden = true;
    void this.places.ask(answer, this.description());
    if (!answer) return;
    const photo = photoOf(answer, this.description());
    this.drawing.flyToAnswer(answer, this.description().views[photo] ?? null);
    if (photo >= 0) void this.openPhoto(photo, answer.evidence?.box_px ?? null);
  }

  /** Shows an object that was clicked: as the answer that it is, or else alone, without a score. */
  showObject(object: Answer): void {
    this.choose(null);
    const index = this.answers.findIndex(({ id }) => id === object.id);
    if (index >= 0) return this.choose(index);
    this.answers = [{ ...object, score: object.score ?? 0 }];
    this.asked = { thing: object.names?.[0]?.name ?? "Unnamed object", query: "", threshold: null, viewpoint: this.viewpoint(), description: this.description() };
    showCards(this.answers, this.asked, (index) => this.choose(index === this.chosen ? null : index));
    say("");
    this.choose(0);
  }

  /** Shows a photo with a box in it. */
  async openPhoto(index: number, boxPx: number[] | null): Promise<void> {
    const photo = this.description().views[index];
    await this.layOver(photo, photo.has_picture ? pictureOf(index) : null, boxPx);
  }

  /** Shows a picture that the slider lays over the scene, seen from where it was taken. */
  async layOver(photo: Photo, picture: Promise<string> | null, boxPx: number[] | null): Promise<void> {
    const opened = ++this.photoOpened;
    try {
      await showPhoto(photo, picture, boxPx, () => this.drawing.standAt(photo), (share) => {
        if (opened !== this.photoOpened) return;
        this.drawing.standAt(photo);
        panel.blend.hidden = share === 0;
        // Properties: the page's policy allows no style attributes in HTML.
        const [left, bottom] = this.drawing.coveredPx;
        Object.assign(panel.blend.style, { opacity: String(share), left: `${left}px`, top: "0", width: `${innerWidth - left}px`, height: `${innerHeight - bottom}px` });
      });
    } catch (error) {
      this.report(error);
    }
  }

  leavePhoto(): void {
    panel.blend.hidden = true;
    const share = document.querySelector<HTMLInputElement>("#blend-share");
    if (share) share.value = "0";
  }
}
