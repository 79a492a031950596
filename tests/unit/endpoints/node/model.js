// A model for a source of the connector "remote": joins it, answers its steps, and prints what it received, as
// one JSON object, when the stream has ended. Usage: node model.js ADDRESS PROTO SOURCE
'use strict';

const grpc = require('@grpc/grpc-js');
const loader = require('@grpc/proto-loader');

const [address, proto, source] = process.argv.slice(2);
const definition = loader.loadSync(proto, { keepCase: true, longs: Number, enums: String, oneofs: true, arrays: true });
const { Shmio } = grpc.loadPackageDefinition(definition).shmio.v1;
const client = new Shmio(address, grpc.credentials.createInsecure());

// The field of Values that has the values of a column, by the column's number.
const FIELDS = {
  COLUMN_BOOL: 'bools', COLUMN_INT32: 'int32s', COLUMN_INT64: 'int64s', COLUMN_UINT64: 'uint64s', COLUMN_FLOAT: 'floats',
  COLUMN_DOUBLE: 'doubles', COLUMN_TEXT: 'texts',
};

// Returns the current values of a table's scalars: those of a message, and earlier ones for the rest.
function take(table, values, known) {
  for (const [column, field] of Object.entries(FIELDS)) {
    const part = values && values[field];
    if (!part) continue;
    const bySlot = new Map(part.values.map((value, i) => [part.slots.length ? part.slots[i] : i, value]));
    for (const register of table.registers) {
      if (register.column === column && register.count === 1 && bySlot.has(register.slot || 0)) {
        known[register.path] = bySlot.get(register.slot || 0);
      }
    }
  }
}

const told = { joined: null, steps: [], status: null };
const inputs = {};
let tables = null;
const stream = client.Simulate();

stream.on('data', (message) => {
  if (message.joined) {
    tables = message.joined;
    told.joined = { inputs: tables.inputs.registers.length, outputs: tables.outputs.registers.map(({ path }) => path) };
    console.error('joined');
    return;
  }
  const { step, time_ns: time, values } = message.work;
  take(tables.inputs, values, inputs);
  told.steps.push([step, time, inputs.target]);
  if (inputs.target < 0) {
    stream.write({ done: { step, failure: 'the target is behind us' } });
    return;
  }
  const position = tables.outputs.registers.find(({ path }) => path === 'axis/position');
  stream.write({
    done: {
      step,
      values: { doubles: { slots: [position.slot || 0], values: [inputs.target * 2] } },
      assignments: [{ path: 'axis/count', value: { integer: step } }],
    },
  });
});

const end = (status) => {
  told.status = status;
  console.log(JSON.stringify(told));
  client.close();
};
stream.on('error', (error) => end(grpc.status[error.code]));
stream.on('end', () => end('OK'));
process.stdin.on('end', () => stream.end()).resume();
stream.write({ join: { source, name: 'model.js' } });
