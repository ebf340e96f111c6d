// North and a scale bar over the picture.

import * as THREE from "three";

const LONGEST_PX = 120;

export class Hud {
  private readonly compass = document.getElementById("compass") as unknown as SVGElement;
  private readonly north = document.getElementById("north")!;
  private readonly bar = document.getElementById("scale-bar")!;
  private readonly text = document.getElementById("scale-text")!;

  constructor(private readonly up: THREE.Vector3, private readonly isMetric: boolean, isGeographic: boolean) {
    // Elsewhere than on the earth there is no north: the world's second axis, which lies where north would.
    this.north.textContent = isGeographic ? "N" : "y";
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
