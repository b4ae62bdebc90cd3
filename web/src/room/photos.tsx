/** The photographs of the scan as thumbnails, and one of them in full, with the objects in color. */

import { useEffect } from "preact/hooks";
import { photographPath } from "../api/service";
import type { FrameView } from "../api/types";
import { t } from "../text";
import { Dialog } from "../ui/dialog";
import { place } from "../ui/fields";
import { Picture } from "../ui/picture";
import { ProblemNote } from "../ui/problem";
import type { Room } from "./state";

export function PhotosPanel({ room: { id, photographs } }: { room: Room }) {
  const { frames, problem, shown, hovered, open, chosen } = photographs;
  useEffect(() => void photographs.load(), []);
  if (problem.value) return <ProblemNote problem={problem.value} onAgain={() => void photographs.load()} />;
  if (!frames.value) return <p class="wait">{t.loading}</p>;
  if (frames.value.length === 0) return <p class="small">{t.photos.none}</p>;
  return (
    <>
      <label class="check">
        <input type="checkbox" checked={shown.value} onChange={(event) => (shown.value = event.currentTarget.checked)} />
        {t.photos.show}
      </label>
      <p class="small">{t.photos.count(chosen.value.length, frames.value.length)}</p>
      <ul class="thumbs">
        {chosen.value.map((frame) => (
          <li key={frame.index}>
            <button
              type="button"
              class="thumbnail"
              title={t.photos.from(place(positionOf(frame)), heading(frame))}
              onClick={() => (open.value = frame.index)}
              onMouseEnter={() => (hovered.value = frame.index)}
              onMouseLeave={() => (hovered.value = null)}
              onFocus={() => (hovered.value = frame.index)}
              onBlur={() => (hovered.value = null)}
            >
              <Picture path={photographPath(id, frame.index, false)} alt="" />
              <span class="small">{t.photos.name(frame.index)}</span>
            </button>
          </li>
        ))}
      </ul>
    </>
  );
}

/** Over everything, wherever it was opened from. */
export function Photograph({ room }: { room: Room }) {
  const { photographs } = room;
  const index = photographs.open.value;
  const all = photographs.frames.value;
  if (index === null || !all) return null;
  const [before, after] = [photographs.beside(-1), photographs.beside(1)];
  const go = (frame: FrameView | null) => {
    if (frame) photographs.open.value = frame.index;
  };
  const keys = (event: KeyboardEvent) => {
    if (event.key === "ArrowLeft") go(before);
    if (event.key === "ArrowRight") go(after);
  };
  const name = t.photos.name(index);
  return (
    <Dialog title={name} wide onClose={() => (photographs.open.value = null)}>
      <div class="photograph" onKeyDown={keys}>
        <Picture path={photographPath(room.id, index, true)} alt={t.photos.alt(name)} />
        <div class="buttons">
          <button type="button" disabled={!before} onClick={() => go(before)}>
            {t.photos.before}
          </button>
          <button type="button" disabled={!after} onClick={() => go(after)}>
            {t.photos.after}
          </button>
          <span class="small figures" role="status">
            {t.photos.which(all.findIndex((frame) => frame.index === index) + 1, all.length)}
          </span>
        </div>
      </div>
    </Dialog>
  );
}

const positionOf = ({ camera_to_world: rows }: FrameView) => [0, 1, 2].map((axis) => rows[axis]![3]!);

/** Where it looks, about Z from +X, degrees: cameras look along their own +Z. */
const heading = ({ camera_to_world: rows }: FrameView) => Math.round((Math.atan2(rows[1]![2]!, rows[0]![2]!) * 180) / Math.PI);
