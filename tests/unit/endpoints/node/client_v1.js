// Calls SimlogAPI version 1 as existing clients do, and prints the result of each step: one JSON object.
// Usage: node client_v1.js ADDRESS PROTO
'use strict';

const grpc = require('@grpc/grpc-js');
const loader = require('@grpc/proto-loader');

const [address, proto] = process.argv.slice(2);
const definition = loader.loadSync(proto, { keepCase: true, longs: String, enums: String, defaults: true, oneofs: true });
const { SimlogAPI } = grpc.loadPackageDefinition(definition).simulation.server;
const client = new SimlogAPI(address, grpc.credentials.createInsecure());
const deadline = () => ({ deadline: Date.now() + 60000 });

const call = (name, request) =>
  new Promise((resolve) =>
    client[name](request, deadline(), (error, answer) => resolve(error ? grpc.status[error.code] : answer)));

// One topic: the messages so far, and a promise of a later one.
class Stream {
  constructor(call) {
    this.seen = [];
    this.waiting = null;
    this.call = call;
    this.open = new Promise((resolve) => this.call.on('metadata', resolve));
    this.ended = new Promise((resolve) => this.call.on('error', (error) => resolve(grpc.status[error.code])));
    this.call.on('data', (message) => {
      this.seen.push({ type: message.type, value: message.value, nsec: message.timeStamp && message.timeStamp.stamp.nsec });
      if (this.waiting) this.waiting();
    });
  }

  async until(value) {
    const there = () => this.seen.find((message) => message.value === value);
    while (!there()) await new Promise((resolve) => { this.waiting = resolve; });
    return there();
  }
}

const subscribe = (path) => new Stream(client.Subscribe({ path, msgType: 'double' }, deadline()));
const inject = (target, shadow) => new Stream(client.Inject({ target: { path: target, msgType: 'double' },
  injected: { path: shadow, msgType: 'double' } }, deadline()));

async function main() {
  const result = {};
  const published = new Promise((resolve) => {
    result.stream = client.Publish(deadline(), (error, answer) => resolve(error ? grpc.status[error.code] : answer));
  });
  const publish = result.stream;
  delete result.stream;
  const put = (path, value) =>
    publish.write({ topic: { path, msgType: 'double' }, data: { type: 'double', value } });
  result.topic = await call('GetTopic', { path: 'axis/position/in' });
  result.unknown = await call('GetTopic', { path: 'joints/none/in' });
  const input = subscribe('axis/position/in');
  const output = subscribe('axis/position/out');
  const nothing = subscribe('joints/none/out');
  result.nothing = await nothing.ended;
  await input.open;
  await output.open;
  put('axis/position/in', '1.0E-4');
  result.input = await input.until('0.0001');
  result.output = await output.until('0.0001');
  put('joints/none/in', '1.0');
  put('axis/position/in', 'what');
  put('axis/position/in', '-0.0');
  result.negative = await output.until('-0.0');
  const originals = inject('axis/position/in', 'axis/position/shadow');
  await originals.open;
  put('axis/position/in', '2.5');
  result.original = await originals.until('2.5');
  put('axis/position/shadow', '3.5');
  result.injected = await output.until('3.5');
  result.taken = await inject('axis/speed/in', 'axis/position/shadow').ended;
  originals.call.cancel();
  result.lifted = await originals.ended;
  let lifted = false;
  const restored = output.until('4.5').then(() => { lifted = true; });
  while (!lifted) {
    put('axis/position/in', '4.5');
    await Promise.race([restored, new Promise((resolve) => setTimeout(resolve, 20))]);
  }
  publish.end();
  result.published = await published;
  input.call.cancel();
  output.call.cancel();
  result.ended = [await input.ended, await output.ended];
  console.log(JSON.stringify(result));
  client.close();
}

main();
