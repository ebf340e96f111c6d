// Pictures of photos: fetched once each, whole or cut to a box; and the small ones that a scene carries.

import { fetchPhoto, fetchThumbnail, type Photo } from "./network";

const SVG = "http://www.w3.org/2000/svg";
/** A crop shows so much around its box, by the box's longer side. */
const AROUND = 0.35;

const pictures = new Map<number, Promise<string>>();

/** Address of a photo's picture, for as long as the page is open. */
export function pictureOf(index: number): Promise<string> {
  let picture = pictures.get(index);
  if (!picture) {
    picture = fetchPhoto(index).then((blob) => URL.createObjectURL(blob));
    picture.catch(() => pictures.delete(index));
    pictures.set(index, picture);
  }
  return picture;
}

/** Of another generation, numbers mean other photos. */
export function forgetPictures(): void {
  for (const picture of pictures.values()) picture.then(URL.revokeObjectURL, () => {});
  pictures.clear();
}

function put(to: Element, values: Record<string, number | string>): void {
  for (const [name, value] of Object.entries(values)) to.setAttribute(name, String(value));
}

/** A photo with a box drawn in it. */
export function photoWithBox(url: string, photo: Photo, boxPx: number[] | null): SVGElement {
  const svg = document.createElementNS(SVG, "svg");
  put(svg, { viewBox: `0 0 ${photo.width_px} ${photo.height_px}`, role: "img", "aria-label": `Photo ${photo.name}` });
  const image = document.createElementNS(SVG, "image");
  put(image, { href: url, width: photo.width_px, height: photo.height_px });
  svg.append(image);
  if (boxPx) {
    const box = document.createElementNS(SVG, "rect");
    put(box, { x: boxPx[0], y: boxPx[1], width: boxPx[2] - boxPx[0], height: boxPx[3] - boxPx[1] });
    svg.append(box);
  }
  return svg;
}

/** The small picture of an object. */
export async function thumbnail(id: string): Promise<HTMLImageElement> {
  const image = document.createElement("img");
  const url = URL.createObjectURL(await fetchThumbnail(id));
  image.addEventListener("load", () => URL.revokeObjectURL(url));
  Object.assign(image, { src: url, alt: "", className: "crop" });
  return image;
}

/** A square cut around a box. */
export async function crop(index: number, photo: Photo, [left, top, right, bottom]: number[]): Promise<SVGElement> {
  const url = await pictureOf(index);
  const side = Math.min(Math.max(right - left, bottom - top) * (1 + AROUND), photo.width_px, photo.height_px);
  const start = (low: number, high: number, all: number) => Math.min(Math.max((low + high - side) / 2, 0), all - side);
  const svg = document.createElementNS(SVG, "svg");
  put(svg, { viewBox: `${start(left, right, photo.width_px)} ${start(top, bottom, photo.height_px)} ${side} ${side}`, class: "crop", "aria-hidden": "true" });
  const image = document.createElementNS(SVG, "image");
  put(image, { href: url, width: photo.width_px, height: photo.height_px });
  svg.append(image);
  return svg;
}
