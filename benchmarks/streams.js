// Subscribers on @grpc/grpc-js, on one connection, that count messages without decoding them. With `stamps`, they also
// read from each message the time at which its frame was published. Usage: node streams.js ADDRESS STARTED_NS. The first line it reads is
// {streams: [{method, request, then: [{method, request}]}], stamps: path of fields, or null}, the requests in base64.
// It prints a line when all calls of all streams are answered and each stream has received a message. For each further
// line that it reads, it prints what has arrived since the line before.
'use strict';

const path = require('path');
const grpc = require(path.join(__dirname, '../tests/unit/endpoints/node/node_modules/@grpc/grpc-js'));

const [address, startedNs] = process.argv.slice(2);
let specification;
const raw = (data) => data;
let messages = 0;
let latencies = [];

// Returns the position after a varint, and its value.
function varint(data, at) {
  let value = 0;
  let scale = 1;
  for (;;) {
    const byte = data[at++];
    value += (byte & 0x7f) * scale;
    if (byte < 0x80) return [value, at];
    scale *= 128;
  }
}

// Returns the value of a field of a protobuf message: a number, or [start, end] of its bytes.
function field(data, [at, end], number) {
  while (at < end) {
    let tag, value;
    [tag, at] = varint(data, at);
    const kind = tag & 7;
    if (kind === 0) [value, at] = varint(data, at);
    else if (kind === 1) at += 8;
    else if (kind === 5) at += 4;
    else {
      const [size, start] = varint(data, at);
      value = [start, start + size];
      at = start + size;
    }
    if (tag >>> 3 === number) return value;
  }
  return 0;
}

function stamp(data) {
  let place = [0, data.length];
  for (const number of specification.stamps) place = field(data, place, number);
  if (specification.seconds) { // a Timestamp
    return field(data, place, 1) * 1e9 + field(data, place, 2);
  }
  return place;
}

const client = new grpc.Client(address, grpc.credentials.createInsecure());

function open({ method, request, then }) {
  return new Promise((resolve, reject) => {
    const stream = client.makeServerStreamRequest(method, raw, raw, Buffer.from(request, 'base64'));
    const left = new Set(['a message', 'all it asks for']);
    const done = (what) => {
      left.delete(what);
      if (!left.size) resolve();
    };
    const next = (error) => {
      if (error) reject(error);
      const call = then.shift();
      if (call) client.makeUnaryRequest(call.method, raw, raw, Buffer.from(call.request, 'base64'), next);
      else done('all it asks for');
    };
    stream.on('error', reject);
    stream.on('metadata', () => next(null));
    stream.on('data', (data) => {
      messages += 1;
      if (specification.stamps) latencies.push((Number(process.hrtime.bigint()) - startedNs - stamp(data)) / 1000);
      done('a message');
    });
  });
}

console.log('"started"');
const lines = require('readline').createInterface({ input: process.stdin });
lines.on('close', () => process.exit(0));
lines.on('line', (line) => {
  if (!specification) {
    specification = JSON.parse(line);
    Promise.all(specification.streams.map(open)).then(() => console.log('"ready"'), (error) => {
      console.error(String(error));
      process.exit(1);
    });
    return;
  }
  console.log(JSON.stringify({ messages, latencies }));
  messages = 0;
  latencies = [];
});
