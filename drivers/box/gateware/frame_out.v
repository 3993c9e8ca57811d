// Frames out: takes the bytes of a frame, adds the CRC, sends it stuffed (COBS) between two zeros.
//
// Give `size` bytes by `put` while `wants`, then it sends by itself; `idle` says that a new frame may begin.
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
  localparam IDLE = 0, FILL = 1, CRC = 2, HEAD = 3, LOOK = 4, SCAN = 5, CODE = 6, COPY = 7, TAIL = 8;
  reg [3:0] state;
  reg [7:0] memory[0:(1<<SIZE_BITS)-1];
  reg [SIZE_BITS-1:0] length, filled, from, to;
  reg [7:0] value;
  reg [1:0] part;
  wire busy, unused;
  wire [31:0] crc;
  wire take = state == FILL && put && wants;
  crc32 sum (.clk(clk), .start(start && idle), .put(take), .data(data), .busy(busy), .value(crc), .good(unused));

  assign idle = state == IDLE;
  assign wants = state == FILL && !busy && filled != length;
  wire write = take || state == CRC;
  wire [7:0] crc_byte = crc[8*part+:8];
  wire sent = out_valid && out_ready;
  wire free = !out_valid || out_ready;
  wire at_end = to == length;

  always @(posedge clk) begin
    value <= memory[to];
    if (write) memory[filled] <= state == CRC ? crc_byte : data;
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
          if (part == 2'd3) begin
            length <= filled + 1'b1;
            state <= HEAD;
          end
        end
        HEAD:
        if (free) begin
          out <= 0;
          out_valid <= 1;
          from <= 0;
          to <= 0;
          state <= LOOK;
        end
        LOOK: state <= SCAN;  // `value` follows `to` a clock later
        SCAN:  // `to` goes on to the next zero, or to the end
        if (at_end || value == 0) state <= CODE;
        else begin
          to <= to + 1'b1;
          state <= LOOK;
        end
        CODE:
        if (free) begin
          out <= to - from + 8'd1;
          out_valid <= 1;
          length <= to;           // the block that is copied ends here
          filled <= length;       // and the frame there
          to <= from;
          state <= COPY;
          part <= 0;
        end
        COPY: begin
          part <= 1;  // wait a clock for `value`
          if (to == length) begin
            length <= filled;
            from <= to + 1'b1;
            to <= to + 1'b1;
            state <= to == filled ? TAIL : LOOK;
          end else if (part != 0 && free) begin
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
