// Decodes and encodes payloads of Sparkplug B with another implementation, Eclipse Tahu's.
// Usage: node sparkplug.js < LINES, each {decode: base64} or {encode: payload}; prints a list with an answer to each.
"use strict";
const { decodePayload, encodePayload } = require("sparkplug-payload").get("spBv1.0");

// Converts a Long to a number. The library treats an Int64 as unsigned if its Long is not the protobuf library's.
function plain(metric) {
  const long = metric.value;
  if (typeof long !== "object" || long === null || !("low" in long)) return metric;
  return { ...metric, value: Number((metric.type === "Int64" ? long.toSigned() : long.toUnsigned()).toString()) };
}

const lines = require("fs").readFileSync(0, "utf8").split("\n").filter(Boolean);
const answers = lines.map((line) => {
  const asked = JSON.parse(line);
  if (asked.decode !== undefined) {
    const { seq, metrics } = decodePayload(Buffer.from(asked.decode, "base64"));
    const told = metrics.map((metric) => ({ ...plain(metric), alias: String(metric.alias), at: String(metric.timestamp) }));
    return { seq: Number(seq), metrics: told };
  }
  return Buffer.from(encodePayload(asked.encode)).toString("base64");
});
process.stdout.write(JSON.stringify(answers));
