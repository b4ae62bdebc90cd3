/** Small pieces that several panels use. */

import type { ComponentChildren } from "preact";
import { useId } from "preact/hooks";

export function Choice<Name extends string>(properties: {
  label: string;
  texts: Record<Name, string>;
  value: Name;
  onChange: (value: Name) => void;
  hint?: string;
}) {
  const { label, texts, value, onChange, hint } = properties;
  const id = useId();
  return (
    <div class="field">
      <label for={id}>{label}</label>
      <select id={id} value={value} onChange={(event) => onChange(event.currentTarget.value as Name)}>
        {(Object.keys(texts) as Name[]).map((name) => (
          <option key={name} value={name}>
            {texts[name]}
          </option>
        ))}
      </select>
      {hint && <span class="small">{hint}</span>}
    </div>
  );
}

export function NumberField(properties: {
  label: string;
  value: number | null;
  onChange: (value: number | null) => void;
  min?: number;
  max?: number;
  step?: number;
}) {
  const { label, value, onChange, ...limits } = properties;
  const id = useId();
  return (
    <div class="field">
      <label for={id}>{label}</label>
      <input
        id={id}
        type="number"
        value={value ?? ""}
        {...limits}
        onChange={(event) => onChange(event.currentTarget.value === "" ? null : event.currentTarget.valueAsNumber)}
      />
    </div>
  );
}

export function Row({ term, children }: { term: ComponentChildren; children: ComponentChildren }) {
  return (
    <>
      <dt>{term}</dt>
      <dd>{children}</dd>
    </>
  );
}

/** A share of a whole, beside its figure. */
export function Meter({ share, label }: { share: number; label: string }) {
  return <meter min={0} max={1} value={Math.max(0, Math.min(1, share))} aria-label={label} />;
}

export const numbers = (values: number[], digits = 2) => values.map((value) => value.toFixed(digits)).join(" × ");
export const place = (values: number[]) => values.map((value) => value.toFixed(2)).join(", ");
