// What cannot be done, as one sentence for the visitor.
export class Refusal extends Error {}

// Text from a file, for a sentence: short, and without control characters.
export function quoted(value) {
    const text = JSON.stringify(value) ?? String(value);
    return text.length > 60 ? `${text.slice(0, 60)}...` : text;
}
