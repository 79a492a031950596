// A Modbus TCP device made with modbus-serial, which shares no code with ours: two units with 2,000 entries in each
// table. It prints its port, and ends with its standard input. It does not know function 22.
'use strict';

const net = require('net');
const { ServerTCP } = require('modbus-serial');

const ENTRIES = 2000;
const units = [0, 1, 2].map(() => ({ words: new Uint16Array(ENTRIES), coils: new Uint8Array(ENTRIES) }));

function entries(kind, address, unit) {
  if (!units[unit] || address >= ENTRIES) {
    throw Object.assign(new Error('no such address'), { modbusErrorCode: 2 });
  }
  return units[unit][kind];
}

const vector = {
  getHoldingRegister: (address, unit) => entries('words', address, unit)[address],
  getInputRegister: (address, unit) => entries('words', address, unit)[address],
  getCoil: (address, unit) => Boolean(entries('coils', address, unit)[address]),
  getDiscreteInput: (address, unit) => Boolean(entries('coils', address, unit)[address]),
  setRegister: (address, value, unit) => { entries('words', address, unit)[address] = value; },
  setCoil: (address, value, unit) => { entries('coils', address, unit)[address] = value ? 1 : 0; },
};

const free = net.createServer().listen(0, '127.0.0.1', () => { // the library does not say which port it has taken
  const { port } = free.address();
  free.close(() => {
    const server = new ServerTCP(vector, { host: '127.0.0.1', port, unitID: 255 });
    server.on('initialized', () => console.log(port));
    server.on('socketError', () => {});
    process.stdin.resume();
    process.stdin.on('end', () => process.exit(0));
  });
});
