// North and a scale bar over the picture.

import * as THREE from "three";

const LONGEST_PX = 120;
/** Height of a label and a gap. */
const LABEL_PX = 24;

export class Hud {
  private readonly element = document.getElementById("hud")!;
  private readonly compass = document.getElementById("compass") as unknown as SVGElement;
  private readonly north = document.getElementById("north")!;
  private readonly bar = document.getElementById("scale-bar")!;
  private readonly text = document.getElementById("scale-text")!;

  constructor(private readonly up: THREE.Vector3, private readonly isMetric: boolean, isGeographic: boolean) {
    // Elsewhere than on the earth there is no north: the world's second axis, which lies where north would.
    this.north.textContent = isGeographic ? "N" : "y";
  }

  /** The top of a label that stands at `[xPx, yPx]`, or beside the compass and the scale if it would cover them. */
  beside([xPx, yPx]: [number, number], widthPx: number): number {
    const { left, right, top, bottom } = this.element.getBoundingClientRect();
    if (xPx > right || xPx + widthPx < left || yPx > bottom || yPx + LABEL_PX < top) return yPx;
    return top > innerHeight / 2 ? top - LABEL_PX : bottom;
  }

  /** `forward`: where the camera looks; `metresPerPx`: at what it looks at. */
  show(forward: THREE.Vector3, metresPerPx: number): void {
    const flat = forward.clone().addScaledVector(this.up, -forward.dot(this.up));
    const north = new THREE.Vector3(0, 1, 0);
    const angle = Math.atan2(flat.clone().cross(north).dot(this.up), flat.dot(north));
    this.compass.style.transform = `rotate(${-angle}rad)`;
    // Its letter stays upright.
    this.north.setAttribute("transform", `rotate(${(angle * 180) / Math.PI} 0 -7)`);
    const longest = LONGEST_PX * metresPerPx;
    const power = 10 ** Math.floor(Math.log10(longest));
    const length = power * ([5, 2].find((factor) => factor * power <= longest) ?? 1);
    this.bar.style.width = `${Math.round(length / metresPerPx)}px`;
    const [value, unit] = this.isMetric ? (length >= 1000 ? [length / 1000, "km"] : length < 1 ? [Math.round(length * 100), "cm"] : [length, "m"]) : [length, "units"];
    this.text.textContent = `${Number((value as number).toPrecision(3))} ${unit}`;
  }
}
