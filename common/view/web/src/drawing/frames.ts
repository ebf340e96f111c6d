// Watches how long frames take while the camera moves, and tells when that is too long.

/** Longest mean time between frames: 25 a second, with some to spare above 20. */
const LONGEST_MS = 40;
/** Frames and time that are averaged. */
const MIN_FRAMES = 4;
const MIN_MS = 1000;
/** Smallest share that is reported at once: the first slow second says little. */
const LEAST_SHARE = 0.4;

export class Frames {
  private startMs: number | null = null;
  private n = 0;

  /** `onSlow` gets the share of the Gaussians that would take `LONGEST_MS` a frame. */
  constructor(private readonly onSlow: (share: number) => void) {}

  /** Counts a frame; `isMoving`: it is drawn because the camera moves. */
  count(nowMs: number, isMoving: boolean): void {
    if (!isMoving) {
      this.startMs = null;
      return;
    }
    if (this.startMs === null) {
      this.startMs = nowMs;
      this.n = 0;
      return;
    }
    this.n++;
    const passedMs = nowMs - this.startMs;
    if (this.n < MIN_FRAMES || passedMs < MIN_MS) return;
    const meanMs = passedMs / this.n;
    this.startMs = nowMs;
    this.n = 0;
    if (meanMs > LONGEST_MS) this.onSlow(Math.max(LONGEST_MS / meanMs, LEAST_SHARE));
  }
}
