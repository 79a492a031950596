// Calls SimlogAPI version 2 as existing clients do, and prints the result of each step: one JSON object.
// Usage: node client.js ADDRESS PROTO
'use strict';

const grpc = require('@grpc/grpc-js');
const loader = require('@grpc/proto-loader');

const [address, proto] = process.argv.slice(2);
const definition = loader.loadSync(proto, { keepCase: true, longs: String, enums: String, defaults: true, oneofs: true });
const { SimlogAPI } = grpc.loadPackageDefinition(definition).simlog.server;
const client = new SimlogAPI(address, grpc.credentials.createInsecure());
const deadline = () => ({ deadline: Date.now() + 60000 });

// Returns the answer of a call, or the name of the status with which it ended.
const call = (name, request) =>
  new Promise((resolve) =>
    client[name](request, deadline(), (error, answer) => resolve(error ? grpc.status[error.code] : answer)));

const number = (value) => ({ type: 'NUMBER', value: { numberValue: value } });

// Converts a google.protobuf.Value to a JavaScript value.
function plain(value) {
  if (value.kind === 'listValue') return value.listValue.values.map(plain);
  if (value.kind === 'structValue') {
    const names = Object.keys(value.structValue.fields).sort(); // a map has no order
    return Object.fromEntries(names.map((name) => [name, plain(value.structValue.fields[name])]));
  }
  return value.kind === 'nullValue' ? null : value[value.kind];
}

// A subscriber's stream: the messages so far, and a promise of a later one.
class Stream {
  constructor(uuid) {
    this.seen = [];
    this.waiting = null;
    this.ended = new Promise((resolve) => {
      this.call = client.CreateSubscriber({ name: 'node', uuid }, deadline());
      this.call.on('error', (error) => resolve(grpc.status[error.code]));
    });
    this.call.on('data', (message) => {
      this.seen.push({ path: message.header.path, type: message.type, value: plain(message.value),
        seconds: Number(message.header.timestamp.seconds) + message.header.timestamp.nanos / 1e9 });
      if (this.waiting) this.waiting();
    });
  }

  async until(path, value) {
    const there = () => this.seen.find((m) => m.path === path && JSON.stringify(m.value) === JSON.stringify(value));
    while (!there()) await new Promise((resolve) => { this.waiting = resolve; });
    return there();
  }
}

async function main() {
  const result = {};
  const published = new Promise((resolve) => {
    result.publish = client.Publish(deadline(), (error) => resolve(error ? grpc.status[error.code] : 'OK'));
  });
  const publish = result.publish;
  const stream = new Stream('u-1');
  result.step = await call('Subscribe', { path: 'SIMLOG://step', subscriberUUID: 'u-1' });
  result.first = await call('Write', { topic: 'CELL://step/in', data: number(7) });
  result.unknown = await call('GetTopicInfo', { path: 'CELL://nothing' });
  result.info = await call('GetTopicInfo', { path: 'CELL://step' });
  for (const path of ['CELL://step/out', 'CELL://step/in', 'cell/inputs', 'cell/axis', 'cell/name', 'cell/running']) {
    await call('Subscribe', { path, subscriberUUID: 'u-1' });
  }
  result.written = await stream.until('CELL://step/out', 7);
  publish.write({ topic: 'CELL://step/in', data: number(8) });
  publish.write({ topic: 'CELL://nothing', data: number(8) });
  publish.write({ topic: 'cell/inputs', data: { type: 'LIST',
    value: { listValue: { values: [{ numberValue: 1 }, { numberValue: 2 }] } } } });
  publish.end();
  result.publish = await published;
  result.echo = await stream.until('CELL://step/in', 8);
  result.list = await stream.until('cell/inputs', [1, 2]);
  await call('PublishSynch', { topic: 'axis/speed', data: number(0.5) });
  result.structure = await stream.until('cell/axis', { position: 0, speed: 0.5 });
  await call('Write', { topic: 'cell/name', data: { value: { stringValue: 'M\u00fcller' } } });
  result.text = await stream.until('cell/name', 'M\u00fcller');
  await call('Write', { topic: 'cell/running', data: { value: { boolValue: true } } });
  result.bit = await stream.until('cell/running', true);
  const { messages } = await call('Read', { path: ['CELL://step', 'cell/axis'] });
  result.read = messages.map((message) => [message.header.path, message.type, plain(message.value)]);
  result.refused = await call('Write', { topic: 'cell/step', data: { value: { stringValue: 'seven' } } });
  result.secret = await call('Write', { topic: 'cell/secret', data: number(1) });
  const shadow = await call('Inject', { targetPath: 'CELL://step/in', shadowPathPrefix: 'a/b' });
  await call('Write', { topic: shadow.shadowPathIn, data: number(20) }); // before any message was received
  result.given = await stream.until('CELL://step/out', 20);
  await call('Subscribe', { path: shadow.shadowPathOut, subscriberUUID: 'u-1' });
  result.original = await call('Write', { topic: 'CELL://step/in', data: number(9) });
  result.original = (await stream.until(shadow.shadowPathOut, 9)).type;
  result.shadow = [await call('GetTopicInfo', { path: shadow.shadowPathIn }),
    await call('GetTopicInfo', { path: shadow.shadowPathOut })].map(({ type, direction }) => [type, direction]);
  const again = new Stream('u-1');
  result.replaced = await stream.ended;
  await call('Subscribe', { path: 'cell/step', subscriberUUID: 'u-1' });
  result.again = await again.until('cell/step', 20);
  again.call.cancel();
  console.log(JSON.stringify(result));
  client.close();
}

main();
