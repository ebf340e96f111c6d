// What changed between the scene's generation and the one before it: listed in the panel, and drawn as boxes by
// kind of change.

import type { Drawing } from "./drawing/drawing";
import type { Change } from "./drawing/marks";
import { type Changes, fetchChanges, type Vector } from "./network";

const TITLES = { appeared: "Appeared", went: "Went", moved: "Moved" };

function listed({ appeared, went, moved }: Changes): Change[] {
  const alone = (kind: Change["kind"]) => (thing: Changes["appeared"][number]): Change =>
    ({ kind, id: thing.id, box: thing.box_in_world, to: thing.position_in_world });
  return [...appeared.map(alone("appeared")), ...went.map(alone("went")),
    ...moved.map(({ from, to }): Change => ({ kind: "moved", id: to.id, box: to.box_in_world, from: from.position_in_world, to: to.position_in_world }))];
}

const metres = (point: Vector) => `${point.map((v) => v.toFixed(2)).join(", ")} m`;

export class ChangesPanel {
  constructor(private readonly drawing: Drawing, private readonly section: HTMLElement) {}

  /** Fetches and shows them, or says why there are none. */
  async show(): Promise<void> {
    this.section.hidden = false;
    try {
      const changes = await fetchChanges();
      const all = listed(changes);
      this.drawing.showChanges(all);
      const heading = document.createElement("h2");
      heading.textContent = `Generation ${changes.old_generation} to ${changes.new_generation}`;
      const summary = document.createElement("p");
      const count = (kind: Change["kind"]) => all.filter((change) => change.kind === kind).length;
      summary.textContent = `${count("appeared")} appeared, ${count("went")} went, ${count("moved")} moved, ${changes.n_same + changes.n_stayed} stayed`;
      const list = document.createElement("ol");
      list.append(...all.map((change) => {
        const button = document.createElement("button");
        button.type = "button";
        button.className = change.kind;
        const way = change.from ? ` by ${Math.hypot(...change.to.map((v, i) => v - change.from![i])).toFixed(2)} m` : "";
        button.textContent = `${TITLES[change.kind]}${way}: ${metres(change.to)}`;
        button.addEventListener("click", () => this.drawing.flyToBox(change.box));
        const item = document.createElement("li");
        item.append(button);
        return item;
      }));
      this.section.replaceChildren(heading, summary, list);
    } catch (error) {
      const reason = document.createElement("p");
      reason.textContent = error instanceof Error ? error.message : String(error);
      this.section.replaceChildren(reason);
    }
  }

  hide(): void {
    this.drawing.showChanges([]);
    this.section.hidden = true;
    this.section.replaceChildren();
  }
}
