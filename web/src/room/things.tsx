/** Everything found in the room, as a list that can be searched; one of them in full. */

import { useMemo, useState } from "preact/hooks";
import type { InstanceView } from "../api/types";
import { t } from "../text";
import { numbers } from "../ui/fields";
import { ThingDetails } from "./thing";
import { CorrectionsSoFar, Gathered } from "./correcting";
import { nameOf } from "./names";
import { addsToChoice } from "./pointing";
import type { Room } from "./state";

type Listed = keyof typeof t.things.levels;

/** Rows drawn at once. */
const ROWS = 150;

export function ThingsPanel({ room }: { room: Room }) {
  const [search, setSearch] = useState("");
  const [level, setLevel] = useState<Listed>("thing");
  const [rows, setRows] = useState(ROWS);
  const found = useMemo(() => {
    const words = search.toLowerCase().split(/\s+/).filter(Boolean);
    return [...room.instances.value.values()].filter(
      (thing) => listedAs(room, thing) === level && words.every((word) => textOf(thing).includes(word)),
    );
  }, [room.instances.value, room.corrections.junk.value, search, level]);

  const list = (
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
        {found.length ? t.things.count(found.length) : t.things.nothing}
      </p>
      <ul class="lines">
        {found.slice(0, rows).map((thing) => (
          <li key={thing.id}>
            <button
              type="button"
              class="line"
              aria-pressed={room.group.value.length ? room.group.value.includes(thing.id) : undefined}
              onClick={(event) => (addsToChoice(event) ? room.gather(thing.id) : room.select(thing.id))}
              onMouseEnter={() => (room.hovered.value = thing.id)}
              onMouseLeave={() => (room.hovered.value = null)}
              onFocus={() => (room.hovered.value = thing.id)}
              onBlur={() => (room.hovered.value = null)}
            >
              <span class="number">{thing.id}</span>
              <span>
                {nameOf(thing)}
                {thing.structure && <span class="small"> {t.things.structure}</span>}
              </span>
              <span class="figures small">{numbers(thing.box.size, 1)}</span>
            </button>
          </li>
        ))}
      </ul>
      {found.length > rows && (
        <button type="button" onClick={() => setRows(rows + ROWS)}>
          {t.more}
        </button>
      )}
    </>
  );
  const selected = room.selected.value === null ? undefined : room.instances.value.get(room.selected.value);
  return (
    <>
      <Gathered room={room} />
      <CorrectionsSoFar room={room} />
      {selected ? <ThingDetails key={selected.id} room={room} thing={selected} /> : list}
    </>
  );
}

/** What people called junk stands alone; what they took apart, and what is joined no longer, nowhere. */
function listedAs(room: Room, { id, dismissed, level }: InstanceView): Listed | null {
  if (dismissed) return room.corrections.junk.value.has(id) ? "junk" : null;
  return level ?? "thing";
}

const textOf = ({ id, label, model_name, given_name, names, colours }: InstanceView) =>
  [id, label, model_name ?? "", given_name ?? "", ...names.map(({ name }) => name), ...Object.keys(colours)].join(" ").toLowerCase();
