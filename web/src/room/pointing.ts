/** What a pointer over the picture does: names what it is over, chooses it, or sets a mark with the tool in hand. */

import type { RefObject } from "preact";
import { useEffect } from "preact/hooks";
import type { Point } from "../view3d/marks";
import type { Viewer } from "../view3d/viewer";
import { OBSERVER_HEIGHT_M, type Room } from "./state";

/** How long a pointer rests before it is asked what it is over, milliseconds. */
const REST_MS = 60;

export function usePointing(viewer: Viewer | null, canvas: RefObject<HTMLCanvasElement | null>, room: Room): void {
  useEffect(() => {
    if (!viewer) return;
    const element = canvas.current!;
    let resting = 0;
    const leave = () => {
      clearTimeout(resting);
      room.hovered.value = room.photographs.hovered.value = null;
    };
    const hover = (event: PointerEvent) => {
      clearTimeout(resting);
      if (event.buttons || event.pointerType === "touch") return leave();
      resting = window.setTimeout(() => {
        const frame = viewer.pickFrame(event.clientX, event.clientY);
        room.photographs.hovered.value = frame;
        const picked = frame === null ? viewer.pick(event.clientX, event.clientY) : null;
        room.hovered.value = picked && room.standing(picked.instance, picked.point);
      }, REST_MS);
    };
    const escape = (event: KeyboardEvent) => {
      // In walk mode Escape leaves it, wherever the focus is.
      if (event.key !== "Escape" || room.walking.value) return;
      if (room.tool.value !== "look") room.tool.value = "look";
      else if (room.group.value.length) room.group.value = [];
      else room.select(null);
    };
    const leaveWalk = (event: KeyboardEvent) => {
      if (event.key === "Escape" && !document.querySelector("dialog[open]")) room.walking.value = false;
    };
    viewer.controls.onClick = (event) => click(viewer, room, event);
    element.addEventListener("pointermove", hover);
    element.addEventListener("pointerleave", leave);
    element.addEventListener("keydown", escape);
    document.addEventListener("keydown", leaveWalk);
    return () => {
      leave();
      element.removeEventListener("pointermove", hover);
      element.removeEventListener("pointerleave", leave);
      element.removeEventListener("keydown", escape);
      document.removeEventListener("keydown", leaveWalk);
    };
  }, [viewer]);
}

/** Whether a click means one more, as in lists of files. */
export const addsToChoice = (event: MouseEvent) => event.ctrlKey || event.metaKey || event.shiftKey;

function click(viewer: Viewer, room: Room, event: PointerEvent): void {
  const frame = viewer.pickFrame(event.clientX, event.clientY);
  const picked = viewer.pick(event.clientX, event.clientY);
  if (room.tool.value === "measure") {
    if (picked) room.ends.value = room.ends.value.length === 1 ? [room.ends.value[0]!, picked.point] : [picked.point];
  } else if (room.tool.value === "observer") {
    if (picked) place(room, picked.point);
  } else if (frame !== null) {
    room.photographs.open.value = frame;
  } else {
    choose(room, picked && room.standing(picked.instance, picked.point), event);
  }
}

function choose(room: Room, id: number | null, event: PointerEvent): void {
  if (!addsToChoice(event)) {
    room.group.value = [];
    // Who clicks a thing sees it already: the view stays.
    room.select(id, false);
  } else if (id !== null) {
    room.gather(id);
  }
}

/** First where somebody stands, then what they look towards. */
function place(room: Room, [x, y]: Point): void {
  const before = room.observer.value;
  if (!before || room.observerPlaced.value) {
    room.observer.value = { position: [round(x), round(y), round(room.floor() + OBSERVER_HEIGHT_M)], yaw_rad: before?.yaw_rad ?? 0 };
    room.observerPlaced.value = false;
  } else {
    const yaw = Math.atan2(y - before.position[1]!, x - before.position[0]!);
    room.observer.value = { ...before, yaw_rad: round(yaw) };
    room.observerPlaced.value = true;
    room.tool.value = "look";
  }
}

const round = (figure: number) => Math.round(figure * 100) / 100;
