/** Controls of the 3D view, and its tools. */

import { useId, useState } from "preact/hooks";
import { t } from "../text";
import { copy } from "../ui/copy";
import { Dialog } from "../ui/dialog";
import { say } from "../ui/say";
import type { Point } from "../view3d/marks";
import type { Coloring } from "../view3d/points";
import type { BoxKind, Room } from "./state";

interface Properties {
  room: Room;
  onWhole: () => void;
  /** Called after a button that wants the view free. */
  onDone?: () => void;
}

/** The controls behind one button, for narrow windows. */
export function ViewMenu(properties: Properties) {
  const [open, setOpen] = useState(false);
  return (
    <div class="view-menu" onKeyDown={(event) => event.key === "Escape" && setOpen(false)}>
      <button type="button" aria-expanded={open} onClick={() => setOpen(!open)}>
        {t.room.view}
      </button>
      {open && <Toolbar {...properties} onDone={() => setOpen(false)} />}
    </div>
  );
}

export function Toolbar({ room, onWhole, onDone }: Properties) {
  const extent = room.scene.value!.extent!;
  const bottom = extent.center[2]! - extent.size[2]! / 2;
  const top = bottom + extent.size[2]!;
  const height = Math.min(room.cutHeight.value, top);
  const [helping, setHelping] = useState(false);
  const measuring = room.tool.value === "measure";
  const measure = () => {
    room.tool.value = measuring ? "look" : "measure";
    if (measuring) room.ends.value = [];
    onDone?.();
  };
  const walk = () => {
    room.walking.value = !room.walking.value;
    onDone?.();
  };
  const whole = () => {
    onWhole();
    onDone?.();
  };
  const { shown } = room.photographs;
  const cameras = () => {
    shown.value = !shown.value;
    onDone?.();
    void room.photographs.load().then(() => {
      if (shown.value && room.photographs.frames.value?.length === 0) say(t.photos.none);
    });
  };
  return (
    <div class="toolbar" role="toolbar" aria-label={t.room.view}>
      <Select
        label={t.room.color}
        texts={t.room.colors}
        value={room.coloring.value}
        onChange={(value: Coloring) => (room.coloring.value = value)}
      />
      <Select label={t.room.boxes} texts={t.room.boxKinds} value={room.boxKind.value} onChange={(value: BoxKind) => (room.boxKind.value = value)} />
      <label class="slide">
        {t.room.cut}
        <input
          type="range"
          min={bottom + 0.1}
          max={top + 0.01}
          step={0.05}
          value={height}
          aria-valuetext={t.meters(height)}
          onInput={(event) => {
            const chosen = event.currentTarget.valueAsNumber;
            room.cutHeight.value = chosen >= top - 0.02 ? Infinity : chosen;
          }}
        />
        <output>{t.meters(height)}</output>
      </label>
      <label class="check">
        <input type="checkbox" checked={room.cutWalls.value} onChange={(event) => (room.cutWalls.value = event.currentTarget.checked)} />
        {t.room.cutWalls}
      </label>
      <span class="buttons">
        <button type="button" class="quiet" onClick={whole}>
          {t.room.whole}
        </button>
        <button type="button" class="quiet" aria-pressed={room.walking.value} onClick={walk}>
          {t.room.walk}
        </button>
        <button type="button" class="quiet" aria-pressed={measuring} onClick={measure}>
          {t.room.measure}
        </button>
        <button type="button" class="quiet" aria-pressed={shown.value} onClick={cameras}>
          {t.photos.cameras}
        </button>
        <button type="button" class="quiet" onClick={() => void copy(location.href, t.room.linkCopied)}>
          {t.room.link}
        </button>
        <button type="button" class="quiet" onClick={() => setHelping(true)}>
          {t.room.help}
        </button>
      </span>
      {helping && (
        <Dialog title={t.room.helpTitle} onClose={() => setHelping(false)}>
          <p>{t.room.canvasHelp}</p>
        </Dialog>
      )}
    </div>
  );
}

function Select<Name extends string>(properties: { label: string; texts: Record<Name, string>; value: Name; onChange: (value: Name) => void }) {
  const { label, texts, value, onChange } = properties;
  const id = useId();
  return (
    <span class="choose">
      <label for={id}>{label}</label>
      <select id={id} value={value} onChange={(event) => onChange(event.currentTarget.value as Name)}>
        {(Object.keys(texts) as Name[]).map((name) => (
          <option key={name} value={name}>
            {texts[name]}
          </option>
        ))}
      </select>
    </span>
  );
}

/** Says what to do next with the tool in use, or its result; or how to walk. */
export function ToolHint({ room }: { room: Room }) {
  const words = hint(room);
  if (!words) return null;
  return (
    <div class="hint">
      <p role="status">{words}</p>
      {room.walking.value && (
        <button type="button" class="quiet" onClick={() => (room.walking.value = false)}>
          {t.room.stopWalking}
        </button>
      )}
    </div>
  );
}

const hasTouch = matchMedia("(pointer: coarse)");

function hint(room: Room): string | null {
  if (room.tool.value === "observer") return t.ask.placing[room.observerPlaced.value ? 0 : 1]!;
  const ends = room.ends.value;
  if (ends.length === 2) {
    const [a, b] = ends as [Point, Point];
    const [dx, dy, dz] = [0, 1, 2].map((i) => Math.abs(a[i]! - b[i]!)) as [number, number, number];
    return t.room.measured(t.meters(Math.hypot(dx, dy, dz)), t.meters(dx), t.meters(dy), t.meters(dz));
  }
  if (room.tool.value === "measure") return t.room.measuring[ends.length]!;
  if (room.walking.value) return hasTouch.matches ? t.room.walkingTouch : t.room.walking;
  return null;
}
