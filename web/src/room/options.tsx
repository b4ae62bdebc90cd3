/** How a question is to be answered; folded away until wanted. */

import type { Observer } from "../api/types";
import { t } from "../text";
import { Choice, NumberField } from "../ui/fields";
import { OBSERVER_HEIGHT_M, type Options, type Room } from "./state";

export function QuestionOptions({ room }: { room: Room }) {
  const options = room.options.value;
  const set = (change: Partial<Options>) => (room.options.value = { ...options, ...change });
  const hasModel = room.models.value?.vlm != null;
  return (
    <details class="options">
      <summary>{t.ask.options}</summary>
      <div class="grid">
        {hasModel && <Choice label={t.ask.reasoner} texts={t.ask.reasoners} value={options.reasoner} onChange={(reasoner) => set({ reasoner })} />}
        <NumberField label={t.ask.k} value={options.top_k} min={1} max={100} onChange={(k) => set({ top_k: k ?? 5 })} />
        <NumberField
          label={t.ask.confidence}
          value={options.min_confidence}
          min={0}
          max={1}
          step={0.05}
          onChange={(least) => set({ min_confidence: least ?? 0.7 })}
        />
        <Choice
          label={t.ask.convention}
          texts={t.ask.conventions}
          value={options.direction_convention}
          onChange={(direction_convention) => set({ direction_convention })}
          hint={t.ask.conventionHint}
        />
        {hasModel && (
          <>
            <Choice label={t.ask.parser} texts={t.ask.parsers} value={options.parser} onChange={(parser) => set({ parser })} />
            <Choice label={t.ask.evidence} texts={t.ask.evidences} value={options.evidence} onChange={(evidence) => set({ evidence })} />
            <NumberField label={t.ask.cost} value={options.max_cost_usd} min={0} step={0.01} onChange={(max_cost_usd) => set({ max_cost_usd })} />
          </>
        )}
      </div>
      <ObserverFields room={room} />
    </details>
  );
}

/** By figures too: a click on the floor is not for everybody. */
function ObserverFields({ room }: { room: Room }) {
  const observer = room.observer.value;
  const start: Observer = observer ?? { position: [0, 0, room.floor() + OBSERVER_HEIGHT_M], yaw_rad: 0 };
  const place = (change: Partial<Observer>) => {
    room.observerPlaced.value = true;
    room.observer.value = { ...start, ...change };
  };
  const [x, y, z] = start.position as [number, number, number];
  return (
    <fieldset>
      <legend>{t.ask.observer}</legend>
      <div class="grid three">
        <NumberField label={t.ask.x} value={observer && x} step={0.1} onChange={(x) => place({ position: [x ?? 0, y, z] })} />
        <NumberField label={t.ask.y} value={observer && y} step={0.1} onChange={(y) => place({ position: [x, y ?? 0, z] })} />
        <NumberField
          label={t.ask.facing}
          value={observer && Math.round((observer.yaw_rad * 180) / Math.PI)}
          step={5}
          onChange={(degrees) => place({ yaw_rad: Math.round(((degrees ?? 0) * Math.PI) / 1.8) / 100 })}
        />
      </div>
      <div class="buttons">
        <button
          type="button"
          aria-pressed={room.tool.value === "observer"}
          onClick={() => (room.tool.value = room.tool.value === "observer" ? "look" : "observer")}
        >
          {t.ask.place}
        </button>
        {observer && (
          <button type="button" class="quiet" onClick={() => (room.observer.value = null)}>
            {t.ask.observerGone}
          </button>
        )}
      </div>
      <p class="small">{t.ask.needsDigits}</p>
    </fieldset>
  );
}
