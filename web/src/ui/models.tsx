/** Which models the server uses, in plain words, and how to get better ones. */

import { useState } from "preact/hooks";
import type { ModelList, Scene } from "../api/types";
import { t } from "../text";
import { Dialog } from "./dialog";
import { Row } from "./fields";

type Part = keyof typeof t.models.parts;

interface Properties {
  models: ModelList;
  /** Models of the open room's parse. */
  parsed?: Scene["models"];
}

export function ModelsNote({ models, parsed }: Properties) {
  const [open, setOpen] = useState(false);
  const parts = partsOf(models, parsed);
  const names = [...new Set([parts.masks, parts.names, models.vlm].filter((name) => name != null))];
  const isComplete = parts.masks !== null && parts.names !== null && models.vlm != null;
  return (
    <div class="small models" role="note" aria-label={t.models.label}>
      {names.length ? t.models.some(names.join(", ")) : t.models.none}{" "}
      <button type="button" class="thing" onClick={() => setOpen(true)}>
        {isComplete ? t.models.about : t.models.better}
      </button>
      {open && (
        <Dialog title={t.models.label} onClose={() => setOpen(false)}>
          <ModelsInFull models={models} parsed={parsed} />
        </Dialog>
      )}
    </div>
  );
}

function ModelsInFull({ models, parsed }: Properties) {
  const parts = partsOf(models, parsed);
  const { builtInParts } = t.models;
  const values: Record<Part, string> = {
    masks: parts.masks ?? builtInParts.masks,
    names: parts.names ?? builtInParts.names,
    reader: models.vlm ? t.models.readerWith(models.vlm) : builtInParts.reader,
    decider: models.vlm ?? builtInParts.decider,
  };
  const now = partsOf(models);
  const isOther = parsed != null && (now.masks !== parts.masks || now.names !== parts.names);
  const lacksNetworks = now.masks === null || now.names === null;
  return (
    <div class="stack">
      <dl class="fields">
        {(Object.keys(values) as Part[]).map((part) => (
          <Row key={part} term={t.models.parts[part]}>
            {values[part]}
          </Row>
        ))}
      </dl>
      {isOther && <p class="warn">{t.models.other}</p>}
      {lacksNetworks && (
        <div>
          <p>{t.models.fetch}</p>
          <pre>uniground serve --fetch-models</pre>
        </div>
      )}
      {!models.vlm && (
        <div>
          <p>{t.models.vlm}</p>
          <pre>uniground serve --vlm-url URL --vlm-model NAME</pre>
        </div>
      )}
      {(lacksNetworks || !models.vlm) && <p>{t.models.again}</p>}
      <p class="small">{t.models.docs}</p>
    </div>
  );
}

/** Names of the neural models that find and name objects; `null` for built-in parts. */
function partsOf({ models }: ModelList, parsed?: Scene["models"]): { masks: string | null; names: string | null } {
  const loaded = (role: string) => models.find((model) => model.role === role)?.name ?? null;
  // A parse names models as `name@fingerprint`, and built-in parts without one.
  const ofParse = (name: string) => (name.includes("@") ? name.split("@")[0]! : null);
  return parsed ? { masks: ofParse(parsed.masks), names: ofParse(parsed.encoder) } : { masks: loaded("masks"), names: loaded("encoder") };
}
