// Mistreats each of the calls given on standard input, and prints how they ended: one JSON object.
// Usage: node rude.js ADDRESS ACT < CALLS, a list of {method, request (base64)}. With the act `hold` all calls stay
// open, each with its message sent, until this program is killed.
'use strict';

const grpc = require('@grpc/grpc-js');

const [address, act] = process.argv.slice(2);
const calls = JSON.parse(require('fs').readFileSync(0));
const client = new grpc.Client(address, grpc.credentials.createInsecure());
const raw = (data) => data;

function begin(call, ms = 60000) {
  const stream = client.makeBidiStreamRequest(call.method, raw, raw, { deadline: Date.now() + ms });
  const ended = new Promise((resolve) => {
    stream.on('error', () => {}); // the status is enough
    stream.on('status', (status) => resolve(grpc.status[status.code]));
  });
  const answered = new Promise((resolve) => {
    stream.on('metadata', resolve);
    ended.then(resolve);
  });
  return { stream, ended, answered };
}

const ACTS = {
  async cancel(call) {
    const { stream, ended } = begin(call);
    stream.write(call.request);
    stream.resume();
    stream.cancel();
    return ended;
  },
  async later(call) {
    const { stream, ended, answered } = begin(call);
    stream.write(call.request);
    stream.resume();
    if (call.many) stream.end();
    await answered;
    stream.cancel();
    return ended;
  },
  async close(call) {
    const { stream, ended } = begin(call);
    stream.resume();
    stream.end();
    return ended;
  },
  async deadline(call) {
    const { stream, ended } = begin(call, 50);
    stream.resume();
    return ended;
  },
  async garbage(call) {
    const { stream, ended } = begin(call);
    stream.resume();
    stream.write(Buffer.alloc(9, 0xff));
    stream.end();
    return ended;
  },
  async oversize(call) {
    const { stream, ended } = begin(call);
    stream.resume();
    stream.write(Buffer.alloc((1 << 20) + 1, 0xff));
    stream.end();
    return ended;
  },
};

async function main() {
  for (const call of calls) call.request = Buffer.from(call.request, 'base64');
  if (act === 'hold') {
    for (const call of calls) {
      const { stream, answered } = begin(call);
      stream.write(call.request);
      stream.pause(); // it never reads
      await Promise.race([answered, new Promise((resolve) => setImmediate(resolve))]);
    }
    console.log('holding');
    return;
  }
  const found = [];
  for (const call of calls) found.push(await ACTS[act](call));
  console.log(JSON.stringify(found));
  client.close();
}

main();
