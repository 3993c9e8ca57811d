// RTEC box link, version 1 (docs/rtec-box-link.md): frames in, ledger targets and answers out.
//
// The bytes come from any line (uart.v, spi.v). All axes are latched in the clock in which READ is known to be whole.
`default_nettype none
module link #(
    parameter AXES = 3,
    parameter SIZE_BITS = 6  // 2 ** SIZE_BITS must exceed 17 + 8 * AXES
) (
    input  wire               clk,
    input  wire               rst,
    // what INFO says
    input  wire [15:0]        boot,
    input  wire [31:0]        box_serial,
    input  wire [7:0]         counter_bits,   // 16, 24 or 32
    input  wire [15:0]        hold_after_ms,
    input  wire [31:0]        counts_per_s,
    // the line
    input  wire [7:0]         rx_data,
    input  wire               rx_valid,
    output wire [7:0]         tx_data,
    output wire               tx_valid,
    input  wire               tx_ready,
    // the axes
    input  wire [32*AXES-1:0] raw,
    input  wire [32*AXES-1:0] inserted,
    input  wire               moving,         // a ledger is on its way
    input  wire               fault,          // an encoder's signal cannot be, remembered
    input  wire               broken,         // and is so now
    output reg  [32*AXES-1:0] target,
    output reg                clear_fault,
    // the watchdog
    input  wire [31:0]        time_us,
    input  wire               held,
    output reg                resumed,
    output reg                heard
);
  localparam [7:0] VERSION = 8'd1, HELLO = 8'h01, READ = 8'h02, COMMAND = 8'h03, RESUME = 8'h04;
  localparam [7:0] INFO = 8'h81, STATE = 8'h82;
  localparam [SIZE_BITS-1:0] HEAD = 4, INFO_SIZE = HEAD + 14, STATE_SIZE = HEAD + 9 + 8 * AXES;
  localparam [SIZE_BITS-1:0] COMMAND_SIZE = HEAD + 2 + 4 * AXES, RESUME_SIZE = HEAD + 2;
  localparam AXIS_BITS = $clog2(AXES + 1);

  wire done;
  wire [SIZE_BITS-1:0] size;
  reg [SIZE_BITS-1:0] at;
  wire [7:0] value;
  frame_in #(.SIZE_BITS(SIZE_BITS)) in (
      .clk(clk), .rst(rst), .data(rx_data), .valid(rx_valid), .done(done), .size(size), .at(at), .value(value)
  );

  reg start, put;
  reg [SIZE_BITS-1:0] out_size;
  wire idle, wants;
  reg [7:0] data;
  frame_out #(.SIZE_BITS(SIZE_BITS)) out (
      .clk(clk), .rst(rst), .start(start), .size(out_size), .idle(idle), .wants(wants), .put(put), .data(data),
      .out(tx_data), .out_valid(tx_valid), .out_ready(tx_ready)
  );

  // A frame is read a byte every two clocks, long before the next one can write over it. A frame that is whole while an
  // answer is being put together is lost, as one on a bad line would be.
  localparam WAIT = 0, LOOK = 1, TAKE = 2, ACT = 3, ANSWER = 4, FILL = 5;
  reg [2:0] state;
  reg [7:0] version, kind;
  reg [15:0] number, asked_boot;
  reg [31:0] word;
  reg [SIZE_BITS-1:0] got;
  reg [AXIS_BITS-1:0] axis;
  reg [1:0] of_word;
  reg [15:0] last_command;
  reg held_before;
  wire taken = kind == COMMAND && size == COMMAND_SIZE && version == VERSION && resumed && asked_boot == boot;
  wire answers_info = kind == HELLO && (size == HEAD || version != VERSION);
  wire answers_read = version == VERSION && kind == READ && size == HEAD;
  wire answers_resume = version == VERSION && kind == RESUME && size == RESUME_SIZE;

  // Answers: the head and the fixed part by number, then the axes out of one long shift register.
  reg [64*AXES-1:0] latched;
  reg [31:0] latched_us;
  reg [SIZE_BITS-1:0] sent;
  wire is_info = answers_info;
  wire [7:0] status = {4'd0, fault, moving, held, !resumed};
  wire [31:0] mask = counter_bits == 8'd16 ? 32'h0000FFFF : counter_bits == 8'd24 ? 32'h00FFFFFF : 32'hFFFFFFFF;
  reg [7:0] fixed;
  always @* begin
    case (sent)
      0: fixed = VERSION;
      1: fixed = is_info ? INFO : STATE;
      2: fixed = number[7:0];
      3: fixed = number[15:8];
      4: fixed = boot[7:0];
      5: fixed = boot[15:8];
      6: fixed = is_info ? box_serial[7:0] : status;
      7: fixed = is_info ? box_serial[15:8] : last_command[7:0];
      8: fixed = is_info ? box_serial[23:16] : last_command[15:8];
      9: fixed = is_info ? box_serial[31:24] : latched_us[7:0];
      10: fixed = is_info ? AXES : latched_us[15:8];
      11: fixed = is_info ? counter_bits : latched_us[23:16];
      12: fixed = is_info ? hold_after_ms[7:0] : latched_us[31:24];
      13: fixed = hold_after_ms[15:8];
      14: fixed = counts_per_s[7:0];
      15: fixed = counts_per_s[15:8];
      16: fixed = counts_per_s[23:16];
      default: fixed = counts_per_s[31:24];
    endcase
  end
  wire from_axes = !is_info && sent >= HEAD + 9;

  integer i;
  always @(posedge clk) begin
    heard <= 0;
    clear_fault <= 0;
    start <= 0;
    put <= 0;
    if (done && state == WAIT) begin  // the instant of READ
      latched_us <= time_us;
      for (i = 0; i < AXES; i = i + 1) latched[64*i+:64] <= {inserted[32*i+:32], raw[32*i+:32] & mask};
    end
    held_before <= held;
    if (held && !held_before) target <= inserted;
    if (rst) begin
      state <= WAIT;
      resumed <= 0;
      last_command <= 0;
      target <= 0;
    end else
      case (state)
        WAIT: begin
          at <= 0;
          got <= 0;
          axis <= 0;
          of_word <= 0;
          if (done) state <= LOOK;
        end
        LOOK: state <= TAKE;
        TAKE: begin
          at <= at + 1'b1;
          got <= got + 1'b1;
          case (got)
            0: version <= value;
            1: kind <= value;
            2: number[7:0] <= value;
            3: number[15:8] <= value;
            4: asked_boot[7:0] <= value;
            5: asked_boot[15:8] <= value;
            default: begin
              word <= {value, word[31:8]};
              of_word <= of_word + 1'b1;
              if (of_word == 2'd3 && taken) begin
                target[32*axis+:32] <= {value, word[31:8]};
                axis <= axis + 1'b1;
              end
            end
          endcase
          state <= got + 1'b1 == size ? ACT : LOOK;
        end
        ACT: begin
          state <= WAIT;
          if (taken) begin
            heard <= 1;
            last_command <= number;
          end
          if (answers_resume && asked_boot == boot && !broken) begin
            if (!resumed) heard <= 1;
            resumed <= 1;
            clear_fault <= 1;
          end
          if (answers_info || answers_read || answers_resume) state <= ANSWER;
        end
        ANSWER:
        if (idle && !start) begin
          start <= 1;
          out_size <= is_info ? INFO_SIZE : STATE_SIZE;
          sent <= 0;
          state <= FILL;
        end
        FILL:
        if (wants && !put && !start) begin
          put <= 1;
          data <= from_axes ? latched[7:0] : fixed;
          if (from_axes) latched <= {8'd0, latched[64*AXES-1:8]};
          sent <= sent + 1'b1;
          if (sent + 1'b1 == out_size) state <= WAIT;
        end
        default: state <= WAIT;
      endcase
  end
endmodule
`default_nettype wire
