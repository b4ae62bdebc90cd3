/** What led to the answer: exactly what a model saw and said, or what counted without one. */

import { getPrompt, getReply } from "../api/service";
import type { Answer, AnswerPrompt, AnswerReply } from "../api/types";
import { t } from "../text";
import { Meter, Row } from "../ui/fields";
import { useLoaded } from "../ui/load";
import { Picture } from "../ui/picture";
import { ProblemNote } from "../ui/problem";
import type { Room } from "./state";

export function WhyPanel({ room }: { room: Room }) {
  const answer = room.answer.value;
  if (!answer) return <p class="small">{t.why.none}</p>;
  const asked = (answer.trace?.calls.length ?? answer.usage.vlm_calls) > 0;
  return (
    <div class="why" data-answer={answer.id}>
      <p class="quote">{answer.query}</p>
      <Times answer={answer} />
      {asked ? <Transcript key={answer.id} answer={answer} /> : <Factors room={room} answer={answer} />}
      <Corrections answer={answer} />
      <Parts answer={answer} />
    </div>
  );
}

function Times({ answer: { timings_ms: times } }: { answer: Answer }) {
  const steps = Object.keys(t.why.steps) as (keyof typeof t.why.steps)[];
  return (
    <section>
      <h3>{t.why.time}</h3>
      <table class="figures">
        <tbody>
          {steps.map((step) => (
            <tr key={step}>
              <th scope="row">{t.why.steps[step]}</th>
              <td>
                <Meter share={times.total ? times[step] / times.total : 0} label={t.why.steps[step]} />
              </td>
              <td class="right">{t.why.ms(times[step])}</td>
            </tr>
          ))}
          <tr>
            <th scope="row">{t.why.total}</th>
            <td />
            <td class="right">{t.why.ms(times.total)}</td>
          </tr>
        </tbody>
      </table>
    </section>
  );
}

function Factors({ room, answer }: { room: Room; answer: Answer }) {
  // The built-in reasoner sets its reasons side by side.
  const factors = answer.answer.explanation.split("; ");
  return (
    <section>
      <h3>{t.why.factors}</h3>
      <p class="small">{t.why.factorsHint}</p>
      <ul>
        {factors.map((factor, i) => (
          <li key={i}>{factor}</li>
        ))}
      </ul>
      {answer.candidates && (
        <table class="figures">
          <tbody>
            {answer.candidates.map(({ id, rank, name, score }) => (
              <tr key={id}>
                <td class="right">{rank}</td>
                <th scope="row">
                  {name || room.name(id)} <span class="number">{id}</span>
                </th>
                <td>
                  <Meter share={score} label={score.toFixed(3)} />
                </td>
                <td class="right">{score.toFixed(3)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {answer.evidence?.map((path) => <Picture key={path} path={path} alt={t.why.picture(nameOf(path))} class="wide" enlarge />)}
    </section>
  );
}

interface Said { prompt: AnswerPrompt; reply: AnswerReply }

function Transcript({ answer }: { answer: Answer }) {
  const { value, problem } = useLoaded<Said>(
    async (signal) => ({ prompt: await getPrompt(answer.id, signal), reply: await getReply(answer.id, signal) }),
    [answer.id],
  );
  const gone = problem?.code === "no_transcript";
  return (
    <section>
      <h3>{t.why.usage}</h3>
      <p class="figures">
        {t.why.calls(answer.usage.vlm_calls)} · {t.why.tokens(answer.usage.prompt_tokens, answer.usage.completion_tokens)} ·{" "}
        {t.why.cost(answer.usage.cost_usd)}
      </p>
      {gone && <p class="warn">{t.why.noTranscript}</p>}
      {problem && !gone && <ProblemNote problem={problem} />}
      {value?.prompt.calls.map((call, i) => (
        <Call key={i} answer={answer} call={call} reply={value.reply.calls[i]} n={i} />
      ))}
    </section>
  );
}

interface CallProperties { answer: Answer; call: AnswerPrompt["calls"][number]; reply?: AnswerReply["calls"][number]; n: number }

function Call({ answer, call, reply, n }: CallProperties) {
  const figures = answer.trace?.calls[n];
  return (
    <details class="call" open>
      <summary>{t.why.call(n + 1, t.why.purposes[call.purpose] ?? call.purpose)}</summary>
      {figures && (
        <p class="figures small">
          {call.purpose} · {t.why.attempts(figures.attempts)} · {t.why.ms(figures.latency_ms)} ·{" "}
          {t.why.tokens(figures.prompt_tokens, figures.completion_tokens)}
        </p>
      )}
      <h4>{t.why.said}</h4>
      {reply?.text != null ? <pre>{reply.text}</pre> : <p class="bad">{`${t.why.failed}: ${reply?.error ?? ""}`}</p>}
      <h4>{t.why.shown}</h4>
      {call.user.map((part, i) =>
        "href" in part ? (
          <figure key={i}>
            <Picture path={part.href} alt={t.why.picture(nameOf(part.href))} class="wide" enlarge />
            <figcaption class="small">{nameOf(part.href)}</figcaption>
          </figure>
        ) : (
          <pre key={i}>{part.text}</pre>
        ),
      )}
      <details>
        <summary>{t.why.system}</summary>
        <pre>{call.system}</pre>
      </details>
      {call.schema != null && (
        <details>
          <summary>{t.why.schema}</summary>
          <pre>{JSON.stringify(call.schema, null, 2)}</pre>
        </details>
      )}
    </details>
  );
}

function Corrections({ answer }: { answer: Answer }) {
  const corrections = answer.trace?.corrections ?? [];
  return corrections.length === 0 ? null : (
    <section>
      <h3>{t.why.corrections}</h3>
      <ul>
        {corrections.map((correction, i) => (
          <li key={i}>{correction}</li>
        ))}
      </ul>
    </section>
  );
}

function Parts({ answer: { models } }: { answer: Answer }) {
  return (
    <section>
      <h3>{t.report.models}</h3>
      <dl class="fields">
        {(["parser", "encoder", "reasoner", "names", "masks"] as const).map(
          (part) =>
            models[part] && (
              <Row key={part} term={t.why.parts[part]}>
                <code>{models[part]}</code>
              </Row>
            ),
        )}
      </dl>
    </section>
  );
}

const nameOf = (path: string) => path.split("/").at(-1)!.replace(/\.jpg$/, "");
