/** Everything found in the room, as a list that can be searched; one of them in full. */

import { useMemo, useState } from "preact/hooks";
import { viewPath } from "../api/service";
import type { InstanceView } from "../api/types";
import { t } from "../text";
import { numbers } from "../ui/fields";
import { Picture } from "../ui/picture";
import { Colors } from "./colors";
import { CorrectionsSoFar, Gathered } from "./correcting";
import { nameOf } from "./names";
import { addsToChoice } from "./pointing";
import { mayFit, fits, searchWords } from "./search";
import type { Room } from "./state";
import { ThingDetails } from "./thing";

type Listed = keyof typeof t.things.levels;

/** Rows drawn at once. */
const ROWS = 150;

export function ThingsPanel({ room }: { room: Room }) {
  const [search, setSearch] = useState("");
  const [level, setLevel] = useState<Listed>("thing");
  const [rows, setRows] = useState(ROWS);
  const { things, building, others, maybe } = useMemo(() => {
    const words = searchWords(search);
    const all = [...room.instances.value.values()];
    const listed = all.filter((thing) => listedAs(room, thing) === level);
    const found = listed.filter((thing) => fits(thing, words));
    // What an answer names may be a part or a group: a search among objects finds those too.
    const isOther = (thing: InstanceView) => ["part", "whole"].includes(listedAs(room, thing) ?? "");
    return {
      things: found.filter(({ structure }) => !structure),
      building: found.filter(({ structure }) => structure),
      others: level === "thing" && words.length ? all.filter((thing) => isOther(thing) && fits(thing, words)) : [],
      maybe: listed.filter((thing) => !fits(thing, words) && mayFit(thing, words)),
    };
  }, [room.instances.value, room.corrections.junk.value, search, level]);
  const all = [...things, ...building, ...others, ...maybe];
  const shown = new Set(all.slice(0, rows));
  const list = (some: InstanceView[], title?: string) =>
    some.some((thing) => shown.has(thing)) && (
      <>
        {title && <h4>{title}</h4>}
        <ul class="lines">
          {some.filter((thing) => shown.has(thing)).map((thing) => (
            <ThingRow key={thing.id} room={room} thing={thing} />
          ))}
        </ul>
      </>
    );

  const selected = room.selected.value === null ? undefined : room.instances.value.get(room.selected.value);
  return (
    <>
      <Gathered room={room} />
      <CorrectionsSoFar room={room} />
      {selected ? (
        <ThingDetails key={selected.id} room={room} thing={selected} />
      ) : (
        <>
          <div class="search">
            <input
              type="search"
              placeholder={t.things.search}
              aria-label={t.things.search}
              value={search}
              onInput={(event) => setSearch(event.currentTarget.value)}
            />
            <select aria-label={t.things.level} value={level} onChange={(event) => setLevel(event.currentTarget.value as Listed)}>
              {(Object.keys(t.things.levels) as Listed[]).map((name) => (
                <option key={name} value={name}>
                  {t.things.levels[name]}
                </option>
              ))}
            </select>
          </div>
          <p class="small" role="status">
            {all.length ? t.things.count(all.length) : t.things.nothing}
          </p>
          {list(things)}
          {list(building, t.things.structures)}
          {list(others, t.things.alsoParts)}
          {list(maybe, t.things.maybe)}
          {all.length > rows && (
            <button type="button" onClick={() => setRows(rows + ROWS)}>
              {t.more}
            </button>
          )}
        </>
      )}
    </>
  );
}

function ThingRow({ room, thing }: { room: Room; thing: InstanceView }) {
  const hover = (over: boolean) => () => (room.hovered.value = over ? thing.id : null);
  return (
    <li>
      <button
        type="button"
        class="line"
        aria-pressed={room.group.value.length ? room.group.value.includes(thing.id) : undefined}
        onClick={(event) => (addsToChoice(event) ? room.gather(thing.id) : room.select(thing.id))}
        onMouseEnter={hover(true)}
        onMouseLeave={hover(false)}
        onFocus={hover(true)}
        onBlur={hover(false)}
      >
        <span class="number">{thing.id}</span>
        <span>
          {nameOf(thing)}
          <Colors thing={thing} />
        </span>
        <span class="figures small">{numbers(thing.box.size, 1)} m</span>
        {thing.views.length > 0 ? <Picture path={viewPath(room.id, thing.id, 0, "crop")} alt="" class="stamp" /> : <span class="picture stamp" />}
      </button>
    </li>
  );
}

/** Junk is listed on its own. What was taken apart, or is no longer joined, is listed nowhere. */
function listedAs(room: Room, { id, dismissed, level }: InstanceView): Listed | null {
  if (dismissed) return room.corrections.junk.value.has(id) ? "junk" : null;
  return level ?? "thing";
}
