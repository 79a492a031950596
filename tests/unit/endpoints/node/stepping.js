// Controls time as existing clients of both generations do, and prints the results: one JSON object.
// Usage: node stepping.js ADDRESS FOLDER_OF_PROTOS STEPS
'use strict';

const path = require('path');
const grpc = require('@grpc/grpc-js');
const loader = require('@grpc/proto-loader');

const [address, folder, count] = process.argv.slice(2);
const options = { keepCase: true, longs: Number, enums: String, defaults: true, oneofs: true };
const load = (name) => grpc.loadPackageDefinition(loader.loadSync(path.join(folder, name), options));
const credentials = grpc.credentials.createInsecure();
const old = new (load('simlog_v1.proto').simulation.server.SimlogAPI)(address, credentials);
const simlog = new (load('simlog_v2.proto').simlog.server.SimlogAPI)(address, credentials);
const time = new (load('simserver.proto').com.ttsnetwork.simulator3.SimServerAPI)(address, credentials);
const ours = new (load('shmio_v1.proto').shmio.v1.Shmio)(address, credentials);
const deadline = () => ({ deadline: Date.now() + 60000 });

const call = (client, name, request) =>
  new Promise((resolve) =>
    client[name](request, deadline(), (error, answer) => resolve(error ? grpc.status[error.code] : answer)));

// The messages of a stream so far, and a promise of a given number of them.
function follow(stream) {
  const followed = { seen: [], waiting: null };
  stream.on('data', (message) => {
    followed.seen.push(message);
    if (followed.waiting) followed.waiting();
  });
  stream.on('error', () => {}); // it is cancelled in the end
  followed.open = new Promise((resolve) => stream.on('metadata', resolve));
  followed.until = async (many) => {
    while (followed.seen.length < many) await new Promise((resolve) => { followed.waiting = resolve; });
    return followed.seen.slice(0, many);
  };
  followed.cancel = () => stream.cancel();
  return followed;
}

const topic = (name) => ({ path: name, msgType: 'double' });

// Version 1: sets the step size, publishes some values, and steps once it has received them, repeatedly: Node does
// not keep the order of messages that belong to different calls.
async function first(result) {
  const clock = follow(old.Subscribe(topic('/model/clock'), deadline()));
  const goal = follow(old.Subscribe(topic('sim/goal/out'), deadline()));
  const written = follow(old.Subscribe(topic('sim/goal/in'), deadline()));
  await Promise.all([clock.open, goal.open, written.open]);
  let sent = 0;
  result.setStepSize = await call(old, 'setStepSize', { step: 20 });
  const publish = old.Publish(deadline(), () => {});
  const expected = ['0'];
  result.codes = [];
  for (let number = 1; number <= Number(count); number++) {
    const values = 1 + (number % 9);
    for (let i = 0; i < values; i++) {
      const request = { topic: topic('sim/goal/in'), data: { type: 'double', value: `${10 * number + i}.0` } };
      publish.write(request);
    }
    await written.until((sent += values));
    expected.push(String(10 * number + values - 1));
    result.codes.push((await call(old, 'step', {})).code);
  }
  publish.end();
  result.goal = (await goal.until(expected.length)).map((message) => message.value);
  result.expected = expected;
  result.clock = (await clock.until(expected.length)).map((message) => [message.content, message.timeStamp.stamp.nsec]);
  clock.cancel();
  goal.cancel();
  written.cancel();
}

// Version 2: the calls in their usual order.
async function second(result) {
  const publish = simlog.Publish(deadline(), () => {});
  const stream = follow(simlog.CreateSubscriber({ name: 'node', uuid: 'n-1' }, deadline()));
  await stream.open;
  const statuses = follow(time.subscribe({}, deadline()));
  await statuses.open;
  for (const path of ['SIMLOG://step', 'SIM://count/out']) await call(simlog, 'Subscribe', { path, subscriberUUID: 'n-1' });
  result.answers = [];
  for (const deltaTime of [50, 0, 50]) result.answers.push(await call(time, 'step', { deltaTime }));
  result.stream = (await stream.until(7)).map((message) => [message.header.path, message.value.numberValue]);
  result.started = await call(time, 'start', { deltaTime: 2 });
  await stream.until(11);
  result.busy = await call(time, 'step', { deltaTime: 2 });
  result.paused = await call(time, 'pause', {});
  result.stopped = await call(time, 'stop', {});
  result.statuses = (await statuses.until(4)).map((status) => [status.deltaTime, status.alive, status.playing]);
  publish.end();
  stream.cancel();
  statuses.cancel();
}

// shmio.v1: many steps in one call, first one at a time, then many at once.
async function third(result) {
  const stream = ours.Steps(deadline());
  const steps = [];
  let seen;
  stream.on('data', (message) => { steps.push(...message.steps); seen(); });
  const until = async (many) => {
    while (steps.length < many) await new Promise((resolve) => { seen = resolve; });
  };
  for (const dt of [20000000, 0]) {
    stream.write({ dt_ns: dt });
    await until(steps.length + 1);
  }
  stream.write({ dt_ns: 1000000, count: 50 });
  await until(52);
  const over = new Promise((resolve) => stream.on('status', (status) => resolve(grpc.status[status.code])));
  stream.end();
  result.stepsEnd = await over;
  result.steps = steps.map((step) => [step.number - steps[0].number, (step.time_ns - steps[0].time_ns) / 1e6]);
}

async function main() {
  const result = {};
  await first(result);
  await second(result);
  await third(result);
  console.log(JSON.stringify(result));
  for (const client of [old, simlog, time, ours]) client.close();
}

main();
