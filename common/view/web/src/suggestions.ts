// Suggestions under a search box: questions asked before, things on board, the model's words. The combobox
// pattern of the ARIA Authoring Practices Guide: the focus stays in the box, and `aria-activedescendant` names
// the suggestion that keys have reached.

import type { Word } from "./network";

const MAX_SUGGESTIONS = 8;
const MAX_CHIPS = 12;
/** While nothing is typed, so many of the last questions stand before the things on board. */
const MAX_HISTORY_AT_FIRST = 4;

export interface Suggestion {
  /** The whole line that the box then has. */
  line: string;
  /** Where it comes from. */
  note: string;
}

/** Suggests lines of the history that contain the text, and words that complete it or, where the model takes any text, its last word. */
export function suggest(line: string, history: string[], words: Word[]): Suggestion[] {
  const typed = line.trimStart().toLowerCase();
  const found: Suggestion[] = [];
  const add = (suggestion: Suggestion) => {
    const isKnown = suggestion.line.toLowerCase() === typed.trimEnd() || found.some((other) => other.line.toLowerCase() === suggestion.line.toLowerCase());
    if (!isKnown && found.length < MAX_SUGGESTIONS) found.push(suggestion);
  };
  const before = history.filter((entry) => entry.toLowerCase().includes(typed.trimEnd()));
  for (const entry of typed ? before : before.slice(0, MAX_HISTORY_AT_FIRST)) add({ line: entry, note: "before" });
  // `chair -wa` goes on with the negative "wall"; words of the model may hold spaces, so two typed words may begin
  // one. A model that lists words without things knows no others: it refuses a phrase around one of them.
  const isFixed = words.some(({ n_things }) => n_things === 0);
  const [, start, last] = line.match(isFixed ? /^(.*\s-|-?)(.*)$/s : /^(.*\s-?|-?)(\S*)$/s) ?? ["", "", line];
  const starts = [{ start: line.startsWith("-") ? "-" : "", part: typed.replace(/^-/, "") }, { start, part: last.toLowerCase() }];
  for (const [matches, isAllowed] of [
    [(word: string, part: string) => word.startsWith(part), true],
    [(word: string, part: string) => /[\s-]/.test(word) && word.replaceAll("-", " ").includes(` ${part}`), typed !== ""],
  ] as [(word: string, part: string) => boolean, boolean][]) {
    if (!isAllowed) continue;
    for (const { start: kept, part } of starts) {
      if (typed && !part) continue;
      for (const { word, n_things } of words) {
        // A negative is one word.
        if ((!typed && n_things === 0) || (kept.endsWith("-") && /\s/.test(word))) continue;
        if (matches(word.toLowerCase(), part)) add({ line: kept + word, note: noteOf(n_things) });
      }
    }
  }
  return found;
}

function noteOf(nThings: number): string {
  return nThings === 0 ? "" : String(nThings);
}

/** Chips of what is on board, each with its number; the first one shows all. */
export function showChips(chips: HTMLElement, words: Word[], onChoose: (word: string) => void): void {
  const onBoard = words.filter(({ n_things }) => n_things > 0);
  const chipOf = (text: string, note: string, onClick: () => void) => {
    const chip = document.createElement("button");
    chip.type = "button";
    chip.textContent = text;
    const number = document.createElement("small");
    number.textContent = note;
    chip.append(number);
    chip.addEventListener("click", onClick);
    return chip;
  };
  const show = (shown: Word[]) => shown.map(({ word, n_things }) => chipOf(word, String(n_things), () => onChoose(word)));
  const isAll = onBoard.length <= MAX_CHIPS || chips.classList.contains("all");
  const more = chipOf("all", String(onBoard.length), () => {
    chips.classList.add("all");
    showChips(chips, words, onChoose);
    chips.querySelector("button")?.focus();
  });
  chips.replaceChildren(...(isAll ? show(onBoard) : [more, ...show(onBoard.slice(0, MAX_CHIPS))]));
}

export class Combobox {
  private suggestions: Suggestion[] = [];
  private active = -1;
  /** Whether suggestions are shown as soon as there are some. */
  private isWanted = false;
  private isPointerDown = false;

  /** `source` suggests lines for a text; `onChoose` is called when the box has a suggestion, `onOpen` when the list opens or closes. */
  constructor(private readonly input: HTMLInputElement, private readonly list: HTMLElement,
    private readonly source: (line: string) => Suggestion[], private readonly onChoose: () => void, private readonly onOpen: () => void) {
    input.addEventListener("focus", () => this.open());
    input.addEventListener("click", () => this.open());
    input.addEventListener("input", () => this.open());
    // What is clicked must not move before the click arrives.
    document.addEventListener("pointerdown", () => (this.isPointerDown = true), true);
    document.addEventListener("pointerup", () => (this.isPointerDown = false), true);
    input.addEventListener("blur", () => {
      if (!this.isPointerDown) return this.close();
      document.addEventListener("pointerup", () => setTimeout(() => this.close()), { once: true });
    });
    input.addEventListener("keydown", (event) => this.key(event));
    // The focus must not leave the box before the click arrives.
    list.addEventListener("pointerdown", (event) => event.preventDefault());
    list.addEventListener("click", (event) => {
      const option = (event.target as Element).closest("[role=option]");
      if (option) this.choose([...this.list.children].indexOf(option));
    });
  }

  /** Shows what there is to suggest now, if the box has the focus. */
  open(): void {
    this.isWanted = document.activeElement === this.input;
    this.suggestions = document.activeElement === this.input ? this.source(this.input.value) : [];
    this.active = -1;
    this.list.replaceChildren(...this.suggestions.map(({ line, note }, index) => {
      const option = document.createElement("li");
      option.id = `${this.list.id}-${index}`;
      option.setAttribute("role", "option");
      const text = document.createElement("span");
      text.textContent = line;
      const from = document.createElement("small");
      from.textContent = note;
      option.append(text, from);
      return option;
    }));
    this.mark();
  }

  /** Suggests again, if the list was not closed: there may be other words. */
  refresh(): void {
    if (this.isWanted) this.open();
  }

  close(): void {
    this.isWanted = false;
    this.suggestions = [];
    this.active = -1;
    this.list.replaceChildren();
    this.mark();
  }

  private mark(): void {
    const isOpen = this.suggestions.length > 0;
    this.list.hidden = !isOpen;
    this.onOpen();
    this.input.setAttribute("aria-expanded", String(isOpen));
    [...this.list.children].forEach((option, index) => option.setAttribute("aria-selected", String(index === this.active)));
    const option = this.list.children[this.active];
    if (option) this.input.setAttribute("aria-activedescendant", option.id);
    else this.input.removeAttribute("aria-activedescendant");
    option?.scrollIntoView({ block: "nearest" });
  }

  private key(event: KeyboardEvent): void {
    const { length } = this.suggestions;
    if (event.isComposing || event.ctrlKey || event.metaKey) return;
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      event.preventDefault();
      if (length === 0) return this.open();
      // One place more than suggestions: the box itself, with no suggestion chosen.
      const step = event.key === "ArrowDown" ? 1 : -1;
      this.active = ((this.active + 1 + step + length + 1) % (length + 1)) - 1;
      this.mark();
    } else if (event.key === "Enter" && this.active >= 0) {
      event.preventDefault();
      this.choose(this.active);
    } else if (event.key === "Enter") {
      this.close();
    } else if (event.key === "Escape" && length > 0) {
      // The first Escape closes the list, a second one is the browser's and empties the box.
      event.preventDefault();
      this.close();
    }
  }

  private choose(index: number): void {
    const chosen = this.suggestions[index];
    if (!chosen) return;
    this.input.value = chosen.line;
    this.close();
    this.onChoose();
  }
}
