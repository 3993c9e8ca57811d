// Frames out: takes the bytes of a frame, adds the CRC, sends it stuffed (COBS) between two zeros.
//
// Give `size` bytes by `put` while `wants`, then it sends by itself; `idle` says that a new frame may begin. It is stuffed
// before its first byte goes out: then a byte is ready 3 clocks after the one before, as a line that cannot wait asks.
`default_nettype none
module frame_out #(
    parameter SIZE_BITS = 6
) (
    input  wire                 clk,
    input  wire                 rst,
    input  wire                 start,   // begin a frame of `size` bytes
    input  wire [SIZE_BITS-1:0] size,
    output wire                 idle,
    output wire                 wants,   // the next byte may be put
    input  wire                 put,
    input  wire [7:0]           data,
    output reg  [7:0]           out,
    output reg                  out_valid,
    input  wire                 out_ready
);
  localparam IDLE = 0, FILL = 1, CRC = 2, LOOK = 3, STUFF = 4, HEAD = 5, CODE = 6, COPY = 7, TAIL = 8;
  reg [3:0] state;
  reg [7:0] memory[0:(1<<SIZE_BITS)-1];
  reg [SIZE_BITS-1:0] length, filled, to, zero;  // `zero`: place of the zero behind `to`, or the end
  reg [7:0] value;
  reg [1:0] part;
  wire busy, unused;
  wire [31:0] crc;
  wire take = state == FILL && put && wants;
  crc32 sum (.clk(clk), .start(start && idle), .put(take), .data(data), .busy(busy), .value(crc), .good(unused));

  assign idle = state == IDLE;
  assign wants = state == FILL && !busy && filled != length;
  wire stuffs = state == STUFF && value == 0;
  wire write = take || state == CRC || stuffs;
  wire [SIZE_BITS-1:0] where = stuffs ? to : filled, distance = zero - to;
  wire [7:0] crc_byte = crc[8*part+:8];
  wire [7:0] what = stuffs ? distance : state == CRC ? crc_byte : data;
  wire sent = out_valid && out_ready;
  wire free = !out_valid || out_ready;

  always @(posedge clk) begin
    value <= memory[to];
    if (write) memory[where] <= what;
    if (sent) out_valid <= 0;
    if (rst) begin
      state <= IDLE;
      out_valid <= 0;
    end else
      case (state)
        IDLE:
        if (start) begin
          length <= size;
          filled <= 0;
          part <= 0;
          state <= FILL;
        end
        FILL:
        if (take) filled <= filled + 1'b1;
        else if (!busy && filled == length) state <= CRC;
        CRC: begin
          filled <= filled + 1'b1;
          part <= part + 1'b1;
          length <= filled + 1'b1;
          zero <= filled + 1'b1;
          to <= filled;
          if (part == 2'd3) state <= LOOK;
        end
        LOOK: state <= STUFF;  // `value` follows `to` a clock later
        STUFF: begin  // from the end: a zero becomes the distance to the one behind it
          if (value == 0) zero <= to;
          to <= to - (to != 0);
          state <= to == 0 ? HEAD : LOOK;
        end
        HEAD:
        if (free) begin
          out <= 0;
          out_valid <= 1;
          state <= CODE;
        end
        CODE:
        if (free) begin
          out <= zero + 8'd1;
          out_valid <= 1;
          part <= 0;
          state <= COPY;
        end
        COPY: begin
          part <= 1;  // wait a clock for `value`
          if (to == length) state <= TAIL;
          else if (part != 0 && free) begin
            out <= value;
            out_valid <= 1;
            to <= to + 1'b1;
            part <= 0;
          end
        end
        TAIL:
        if (free) begin
          out <= 0;
          out_valid <= 1;
          state <= IDLE;
        end
        default: state <= IDLE;
      endcase
  end
endmodule
`default_nettype wire
