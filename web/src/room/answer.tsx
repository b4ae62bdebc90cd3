/** An answer: what was found, how sure, how the question was read, and what else it may mean. */

import { viewPath } from "../api/service";
import type { Answer } from "../api/types";
import { amend } from "../route";
import { t } from "../text";
import { copy } from "../ui/copy";
import { Meter, numbers, place, Row } from "../ui/fields";
import { Picture } from "../ui/picture";
import { asCurl, asJson, asPython } from "./snippets";
import type { Room } from "./state";

/** Candidates that are listed where nothing fits. */
const NEAREST = 3;

export function AnswerCard({ room, answer }: { room: Room; answer: Answer }) {
  const { status, targets = [] } = answer;
  const isMatch = status !== "no_match";
  const percent = Math.round(answer.confidence * 100);
  const sure = t.answer.sure(percent);
  const candidates = (answer.candidates ?? []).map(({ score, ...one }) => ({ ...one, share: score }));
  return (
    <article class={`answer ${status}`} aria-label={t.answer.title} data-answer={answer.id}>
      <p class="answer-head">
        <span class={`badge ${status}`}>{t.answer.status[status]}</span>
        <Meter share={answer.confidence} label={sure} />
        <span>{sure}</span>
      </p>
      {answer.understood_as && <p class="small">{t.answer.understoodAs(answer.understood_as)}</p>}
      {answer.text && <p class="sentence">{answer.text}</p>}
      <Headline room={room} answer={answer} />
      <Marked room={room} answer={answer} />
      {answer.no_match_reason && <p>{t.answer.reasons[answer.no_match_reason]}</p>}
      {!answer.no_match_reason && !answer.text && <p>{answer.answer.explanation}</p>}
      {answer.degraded && <p class="warn">{t.answer.degraded}</p>}
      {!answer.stored && <p class="warn">{t.answer.notStored}</p>}
      {!room.sameParse.value && <p class="warn">{t.room.otherParse}</p>}
      {answer.seen && <Seen answer={answer} />}
      {targets.length > 1 && (
        <>
          <h4>{t.answer.several(targets.length)}</h4>
          <Instances room={room} entries={targets.map(({ confidence, id, name, distance_m }) => ({ id, name: !distance_m || distance_m < 0.01 ? name : `${name}, ${t.meters(distance_m)}`, share: confidence, view: cropOf(room, id) }))} />
        </>
      )}
      {answer.alternatives.length > 0 && (
        <>
          <h4>{t.answer.alternatives}</h4>
          <Instances room={room} entries={answer.alternatives.map(({ confidence, ...one }) => ({ ...one, share: confidence }))} />
        </>
      )}
      {!isMatch && candidates.length > 0 && (
        <>
          <h4>{t.answer.nearest}</h4>
          <Instances room={room} entries={candidates.slice(0, NEAREST)} />
        </>
      )}
      <Reading answer={answer} />
      <SixFields answer={answer} />
      {isMatch && candidates.length > 0 && (
        <details open={room.showCandidates.value} onToggle={(event) => (room.showCandidates.value = event.currentTarget.open)}>
          <summary>
            {t.answer.candidates} ({candidates.length})
          </summary>
          <Instances room={room} entries={candidates} />
        </details>
      )}
      <div class="buttons copies">
        <button type="button" onClick={() => amend({ tab: "why" }, true)}>
          {t.answer.why}
        </button>
        <span class="small">{t.answer.copy}</span>
        <button type="button" class="quiet" onClick={() => void copy(asCurl(room.id, room.request()))}>
          {t.answer.copies.curl}
        </button>
        <button type="button" class="quiet" onClick={() => void copy(asPython(room.id, room.request()))}>
          {t.answer.copies.python}
        </button>
        <button type="button" class="quiet" onClick={() => void copy(asJson(room.request()))}>
          {t.answer.copies.json}
        </button>
        <button type="button" class="quiet" onClick={() => void copy(JSON.stringify(answer, null, 2))}>
          {t.answer.copies.answer}
        </button>
      </div>
    </article>
  );
}

function Headline({ room, answer }: { room: Room; answer: Answer }) {
  const { status, targets = [], answer: fields, box } = answer;
  const meaning = t.answer.meaning[status];
  const id = fields.predicted_id;
  return (
    <>
      {answer.count != null && !answer.text && <p class="big">{t.answer.count(answer.count)}</p>}
      {id != null && (
        <p class="big">
          <button type="button" class="thing" onClick={() => room.sameParse.value && room.select(id)}>
            {targets.find((target) => target.id === id)?.name ?? room.name(id)}
          </button>{" "}
          <span class="small">{t.answer.instance(id)}</span>
        </p>
      )}
      {box && (
        <p class="figures small">
          {t.answer.size(numbers(box.size))} · {t.answer.center(place(box.center))}
        </p>
      )}
      {meaning && <p>{meaning}</p>}
    </>
  );
}

/** The photograph that shows the answer best, with its box drawn in. */
function Marked({ room, answer }: { room: Room; answer: Answer }) {
  const id = answer.answer.predicted_id;
  const view = id != null && room.sameParse.value ? room.instances.value.get(id)?.views[0] : undefined;
  if (id == null || !view) return null;
  const name = t.answer.photo(room.name(id), view.frame);
  return (
    <figure class="marked">
      <Picture path={viewPath(room.id, id, 0, "frame")} alt={name} enlarge />
      <figcaption class="small">{name}</figcaption>
    </figure>
  );
}

/** The path of the picture that shows an object best, cut out. */
function cropOf(room: Room, id: number): string | null {
  const isShown = room.sameParse.value && room.instances.value.get(id)?.views.length;
  return isShown ? viewPath(room.id, id, 0, "crop") : null;
}

/** Where a vision-language model sees what the parse has not found: the picture, and the place in it. */
function Seen({ answer }: { answer: Answer }) {
  const seen = answer.seen!;
  const path = answer.evidence?.find((path) => path.endsWith(`/${seen.picture}.jpg`));
  const [x, y] = seen.at as [number, number];
  return (
    <figure class="seen">
      {path && (
        <span class="pinned">
          <Picture path={path} alt={t.answer.seen(seen.name)} />
          <span class="pin" aria-hidden="true" style={{ left: `${x * 100}%`, top: `${y * 100}%` }} />
        </span>
      )}
      <figcaption>{t.answer.seen(seen.name)}</figcaption>
    </figure>
  );
}

interface Entry { id: number; name?: string; share: number; view?: string | null }

function Instances({ room, entries }: { room: Room; entries: Entry[] }) {
  return (
    <ul class="lines">
      {entries.map(({ id, name, share, view }) => (
        <li key={id}>
          <button
            type="button"
            class="line"
            aria-pressed={room.selected.value === id}
            disabled={!room.sameParse.value}
            onClick={() => room.select(id)}
            onMouseEnter={() => (room.hovered.value = id)}
            onMouseLeave={() => (room.hovered.value = null)}
          >
            <span class="number">{id}</span>
            <span>{name || room.name(id)}</span>
            {view && <Picture path={view} alt="" class="stamp" />}
            <Meter share={share} label={share.toFixed(2)} />
            <span class="figures">{share.toFixed(2)}</span>
          </button>
        </li>
      ))}
    </ul>
  );
}

function Reading({ answer: { parsed_query: read } }: { answer: Answer }) {
  const parts: [string, string[]][] = [
    [t.answer.target, read.target ? [read.target] : []],
    [t.answer.attributes, read.attributes],
    [t.answer.relations, read.relations],
    [t.answer.anchors, read.anchors],
  ];
  return (
    <>
      <h4>{t.answer.reading}</h4>
      <dl class="reading">
        {parts.map(
          ([term, words]) =>
            words.length > 0 && (
              <Row key={term} term={term}>
                {words.map((word, i) => (
                  <span key={i} class="word">
                    {word}
                  </span>
                ))}
              </Row>
            ),
        )}
        {read.not_understood.length > 0 && (
          <Row term={t.answer.notUnderstood}>
            {read.not_understood.map((word, i) => (
              <span key={i} class="word lost">
                {word}
              </span>
            ))}
          </Row>
        )}
      </dl>
    </>
  );
}

function SixFields({ answer: { answer: fields } }: { answer: Answer }) {
  const names = Object.entries(fields.candidate_names);
  const matches = fields.target_name_matches;
  return (
    <details>
      <summary>{t.answer.fields}</summary>
      <dl class="fields">
        <Row term={t.answer.field.predicted_id}>{fields.predicted_id ?? t.none}</Row>
        <Row term={t.answer.field.explanation}>{fields.explanation}</Row>
        <Row term={t.answer.field.candidate_names}>{names.length ? names.map(([id, name]) => `${id} ${name}`).join(", ") : t.none}</Row>
        <Row term={t.answer.field.target_name_matches}>{matches == null ? t.none : matches ? t.yes : t.no}</Row>
        <Row term={t.answer.field.anchor_id}>{fields.anchor_id ?? t.none}</Row>
        <Row term={t.answer.field.relation_used}>{fields.relation_used ?? t.none}</Row>
      </dl>
    </details>
  );
}
