/** One thing: name, size, colors, what carries it, photographs; and how far it is from another. */

import { useEffect, useRef, useState } from "preact/hooks";
import { viewPath } from "../api/service";
import type { InstanceView, OrientedBox, Support } from "../api/types";
import { amend } from "../route";
import { t } from "../text";
import { numbers, place, Row } from "../ui/fields";
import { Picture } from "../ui/picture";
import { RenameForm } from "../ui/rename";
import { Colors } from "./colors";
import { NAME_LENGTH, Wrong } from "./correcting";
import { nameOf } from "./names";
import type { Room } from "./state";

export function ThingDetails({ room, thing }: { room: Room; thing: InstanceView }) {
  const heading = useRef<HTMLHeadingElement>(null);
  const name = nameOf(thing);
  useEffect(() => {
    // Who came from the list by keyboard goes on here; who clicked in the picture stays there.
    if (document.activeElement === document.body) heading.current!.focus();
  }, [thing.id]);
  const [renaming, setRenaming] = useState(false);
  const rename = (name: string) => {
    setRenaming(false);
    if (name && name !== nameOf(thing)) void room.correct({ kind: "rename", instance_id: thing.id, name });
  };
  const all = room.instances.value;
  const carried = [...all.values()].filter(({ level, support, dismissed }) => level === "thing" && !dismissed && support.on === "instance" && support.id === thing.id);
  const parts = [...all.values()].filter(({ level, things }) => level === "part" && things?.includes(thing.id));
  const { oriented_box: box } = thing;
  const degrees = Math.round((box.yaw_rad * 180) / Math.PI);
  return (
    <article class="thing-details" data-instance={thing.id}>
      <button type="button" class="quiet" onClick={() => room.select(null)}>
        ← {t.things.close}
      </button>
      {renaming ? (
        <RenameForm name={name} label={t.corrections.newName} maxLength={NAME_LENGTH} onDone={rename} />
      ) : (
        <div class="named">
          <h3 ref={heading} tabIndex={-1} class="big">
            {name} <span class="small">{t.answer.instance(thing.id)}</span>
          </h3>
          <button type="button" class="quiet" onClick={() => setRenaming(true)}>
            {t.rename}
          </button>
        </div>
      )}
      {thing.views[0] && <Picture path={viewPath(room.id, thing.id, 0, "crop")} alt={t.things.view(name, thing.views[0].frame)} class="crop" enlarge />}
      <dl class="fields">
        <Row term={t.things.size}>{numbers(box.size)} m</Row>
        <Row term={t.things.center}>{place(box.center)} m</Row>
        {degrees !== 0 && <Row term={t.things.yaw}>{degrees}°</Row>}
        <Row term={t.things.colors}>
          <Colors thing={thing} inFull />
        </Row>
        <Row term={t.things.support}>
          <Carrier room={room} support={thing.support} />
        </Row>
        <Row term={t.things.height}>{t.meters(thing.height_above_floor_m)}</Row>
        {carried.length > 0 && (
          <Row term={t.things.carries}>
            <Links room={room} things={carried} />
          </Row>
        )}
        {thing.things && thing.things.length > 0 && (
          <Row term={thing.level === "part" ? t.things.partOf : t.things.madeOf}>
            <Links room={room} things={thing.things.flatMap((id) => all.get(id) ?? [])} />
          </Row>
        )}
        {parts.length > 0 && (
          <Row term={t.things.parts}>
            <Links room={room} things={parts} />
          </Row>
        )}
        {thing.model_name && <Row term={t.things.modelName}>{thing.model_name}</Row>}
        {thing.names.length > 0 && (
          <Row term={t.things.names}>{thing.names.map((guess) => `${guess.name} ${guess.score.toFixed(2)}`).join(", ")}</Row>
        )}
        <Row term={t.things.points}>{thing.point_count.toLocaleString("en")}</Row>
        <Row term={t.things.flat}>{Math.round(thing.planarity * 100)} %</Row>
      </dl>
      <Measuring room={room} thing={thing} />
      <Wrong room={room} thing={thing} />
      <h4>{t.things.views}</h4>
      {thing.views.length === 0 && <p class="small">{t.things.noViews}</p>}
      <div class="thumbs">
        {thing.views.map((view, k) => (
          <figure key={view.frame} class="thumbnail">
            <Picture path={viewPath(room.id, thing.id, k, "frame")} alt={t.things.view(name, view.frame)} enlarge />
            <figcaption class="small">{t.things.photo(view.frame)}</figcaption>
          </figure>
        ))}
      </div>
    </article>
  );
}


function Carrier({ room, support }: { room: Room; support: Support }) {
  if (support.on === "floor" || support.on === "nothing") return <>{t.things.supports[support.on]}</>;
  const carrier = room.instances.value.get(support.id);
  const text = support.on === "wall" ? t.things.wall(support.id) : t.things.onThing(carrier ? nameOf(carrier) : "", support.id);
  return (
    <button type="button" class="thing" onClick={() => room.select(support.id)}>
      {text}
    </button>
  );
}

function Links({ room, things }: { room: Room; things: InstanceView[] }) {
  return (
    <span class="links">
      {things.slice(0, 12).map((thing) => (
        <button type="button" key={thing.id} class="thing" onClick={() => room.select(thing.id)}>
          {t.things.onThing(nameOf(thing), thing.id)}
        </button>
      ))}
    </span>
  );
}

/** Between two things, without a pointer. */
function Measuring({ room, thing }: { room: Room; thing: InstanceView }) {
  const from = room.measureFrom.value === null ? undefined : room.instances.value.get(room.measureFrom.value);
  const measure = () => {
    room.ends.value = [from!.oriented_box.center, thing.oriented_box.center].map((c) => [c[0]!, c[1]!, c[2]!]);
  };
  const other = from && from.id !== thing.id ? from : undefined;
  return (
    <>
      <div class="buttons">
        <button
          type="button"
          onClick={() => {
            room.question.value = t.ask.example.unique(nameOf(thing));
            amend({ tab: "ask" });
          }}
        >
          {t.things.ask}
        </button>
        <button type="button" aria-pressed={from?.id === thing.id} onClick={() => (room.measureFrom.value = thing.id)}>
          {t.things.measureFrom}
        </button>
        {other && (
          <button type="button" onClick={measure}>
            {t.things.measureTo(nameOf(other))}
          </button>
        )}
      </div>
      {other && (
        <p class="small" role="status">
          {t.things.between(nameOf(other), nameOf(thing), t.meters(apart(other.oriented_box, thing.oriented_box)), t.meters(gap(other, thing)))}
        </p>
      )}
    </>
  );
}

const apart = (a: OrientedBox, b: OrientedBox) => Math.hypot(...[0, 1, 2].map((i) => a.center[i]! - b.center[i]!));

/** Between axis-aligned boxes; 0 where they touch. */
function gap(a: InstanceView, b: InstanceView): number {
  const along = (i: number) => Math.max(0, Math.abs(a.box.center[i]! - b.box.center[i]!) - (a.box.size[i]! + b.box.size[i]!) / 2);
  return Math.hypot(along(0), along(1), along(2));
}
